// The row above the picture: what a drag draws, what is shown, undo.

import { html } from "../vendor/htm-preact.js";
import { redo, undo } from "../app/asking.js";
import { set } from "../app/store.js";

const TOOLS = [
  ["select", "Move", "Drag the arrow's tip, boxes, or points of the path."],
  ["mover", "What moves", "Draw a box around what moves."],
  ["object", "Another object", "Draw a box around another object, then name it."],
  ["direction", "Direction", "Drag from the object to where it goes."],
];
const LAYER_NAMES = { names: "Names", path: "Path", band: "Band", futures: "Futures" };
const LAYER_HINTS = {
  names: "Names of what was found",
  path: "The path of what moves",
  band: "Where most of the computed worlds have it",
  futures: "Where it is in some other worlds",
};

export function Tools({ state, layers, setLayers, hasFutures }) {
  const { tool, past, future, result } = state;
  const shown = Object.keys(LAYER_NAMES).filter((name) => name !== "futures" || hasFutures);
  return html`<div class="tools">
    <div class="segments" role="group" aria-label="What dragging does">
      ${TOOLS.map(([name, label, hint]) => html`<button key=${name} aria-pressed=${tool === name} title=${hint} onClick=${() => set({ tool: name })}>${label}</button>`)}
    </div>
    <div class="segments" role="group" aria-label="Undo and redo">
      <button onClick=${undo} disabled=${!past.length} title="Undo (Ctrl+Z)">Undo</button>
      <button onClick=${redo} disabled=${!future.length} title="Redo (Ctrl+Shift+Z)">Redo</button>
    </div>
    ${result?.simulation && html`<div class="layers" role="group" aria-label="What is drawn over the picture">
      ${shown.map((name) => html`<label key=${name} title=${LAYER_HINTS[name]}><input type="checkbox" checked=${layers[name]}
        onChange=${(event) => setLayers({ ...layers, [name]: event.target.checked })} />${LAYER_NAMES[name]}</label>`)}
    </div>`}
    ${tool !== "select" && html`<p class="hint" role="status">${TOOLS.find(([name]) => name === tool)[2]}</p>`}
  </div>`;
}
