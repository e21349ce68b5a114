// The row above the picture: what a drag draws, what is shown, undo.

import { html } from "../vendor/htm-preact.js";
import { redo, undo } from "../app/asking.js";
import { set } from "../app/store.js";

const TOOLS = [
  ["select", "Move", "Drag the arrow's tip, boxes, or points of the path."],
  ["mover", "What moves", "Draw a box around the moving object."],
  ["object", "Another object", "Draw a box around another object, then name it."],
  ["direction", "Direction", "Drag from the object to where it goes."],
];
const CLICKS = {
  select: "Click the moving object, or draw a box around it: choose “What moves”.",
  mover: "Click the moving object, or draw a box around it.",
  object: "Click another object, or draw a box around it; then name it.",
};
const LAYER_NAMES = { names: "Names", path: "Path", band: "Band", futures: "Futures", floor: "Floor" };
const LAYER_HINTS = {
  names: "Names of the objects found",
  path: "The path of the moving object",
  band: "Where most simulated versions have it",
  futures: "Where some other simulated versions have it",
  floor: "The floor as a grid, to correct the tilt of the camera",
};

/** What to do now. `isSeeing`: what is clicked is outlined by the server. */
function hintOf({ tool, lit, result }, isSeeing) {
  if (!isSeeing && tool === "select" && !result?.simulation) return "Ask what would happen; then drag the arrow to see other outcomes.";
  if (!isSeeing && tool === "select") return result.simulation.trajectory.live ? "Drag the tip of the arrow: the outcome changes at once." : "Drag boxes, or points of the path, where something was misread.";
  if (!isSeeing) return TOOLS.find(([name]) => name === tool)[2];
  if (lit?.others) return `Click again for another of the ${lit.others + 1} objects that overlap here.`;
  return lit && !lit.things.length ? "Nothing was found here: draw a box." : CLICKS[tool];
}

export function Tools({ state, layers, setLayers, hasFutures, hasFloor, isSeeing }) {
  const { tool, past, future, result } = state;
  const told = hintOf(state, isSeeing);
  const shown = Object.keys(LAYER_NAMES).filter((name) => ({ futures: hasFutures, floor: hasFloor })[name] ?? true);
  return html`<div class="tools">
    <div class="segments" role="group" aria-label="What dragging does">
      ${TOOLS.map(([name, label, hint]) => html`<button key=${name} aria-pressed=${tool === name} title=${hint} onClick=${() => set({ tool: name })}>${label}</button>`)}
    </div>
    <div class="segments" role="group" aria-label="Undo and redo">
      <button onClick=${undo} disabled=${!past.length} title="Undo (Ctrl+Z)">Undo</button>
      <button onClick=${redo} disabled=${!future.length} title="Redo (Ctrl+Shift+Z)">Redo</button>
    </div>
    ${html`<div class=${result?.simulation ? "layers" : "layers empty"} role="group" aria-label="What is drawn over the picture">
      ${shown.map((name) => html`<label key=${name} title=${LAYER_HINTS[name]}><input type="checkbox" checked=${layers[name]}
        onChange=${(event) => setLayers({ ...layers, [name]: event.target.checked })} />${LAYER_NAMES[name]}</label>`)}
    </div>`}
    ${told && html`<p class="hint" role="status">${told}</p>`}
  </div>`;
}
