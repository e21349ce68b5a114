// The floor as a grid that is dragged when it is wrong: up and down changes how far down the camera looks.

import { html, useState } from "../vendor/htm-preact.js";
import { correct } from "../app/asking.js";
import { clamp, floorGrid, horizonOf, rounded } from "../app/geometry.js";
import { useDrag } from "./handles.js";

const [LOWEST, HIGHEST] = [-20, 80]; // degrees: beyond, there is no floor to be seen as a grid
const LEAST_FLOOR = 48; // CSS px of the picture's lower edge that can be dragged, wherever the horizon is

const words = (pitch) => `The camera looks ${pitch < 0 ? "up" : "down"} by ${Math.abs(rounded(pitch))}°`;

/** The grid over the picture. `camera` is that of the result, with what was corrected. */
export function Floor({ camera, corrections, size, unit, isEditable }) {
  const [dragged, setDragged] = useState(null); // the pitch meanwhile, degrees
  const pitch = dragged ?? camera.pitch;
  const pitchAfter = (dy) => clamp(camera.pitch - (Math.atan2(dy, camera.focal) * 180) / Math.PI, LOWEST, HIGHEST);
  const drag = useDrag(unit, (dx, dy) => setDragged(pitchAfter(dy)), (dx, dy) => {
    setDragged(null);
    if (Math.abs(dy) >= 2 * unit) correct({ camera: { ...corrections.camera, pitch: rounded(pitchAfter(dy)) } });
  });
  const shown = { ...camera, pitch };
  const { grid, horizon } = floorGrid(shown, size, unit);
  const top = clamp(horizonOf(shown, size), 0, size.height - LEAST_FLOOR * unit);
  return html`<g class="floor">
    <path class="halo" d=${grid} /><path class="lines" d=${grid} /><path class="horizon" d=${horizon} />
    ${isEditable && html`<rect class="grip" x="0" y=${top} width=${size.width} height=${size.height - top} tabindex="0" role="slider" aria-orientation="vertical"
      aria-label="Floor" aria-valuemin=${LOWEST} aria-valuemax=${HIGHEST} aria-valuenow=${rounded(pitch)} aria-valuetext=${words(pitch)} ...${drag} />`}
    ${dragged !== null && html`<text class="name" x=${8 * unit} y=${size.height - 10 * unit} font-size=${15 * unit}>${words(pitch)}</text>`}
  </g>`;
}

/** What the grid says, below the picture. */
export function FloorLine({ camera, corrections }) {
  const { pitch, ...rest } = corrections.camera ?? {};
  return html`<p class="hint">${words(camera.pitch)}. Drag the floor up or down until the grid lies on it.
    ${pitch !== undefined && html` <button class="plain" onClick=${() => correct({ camera: Object.keys(rest).length ? rest : null })}>Reset the camera</button>`}</p>`;
}
