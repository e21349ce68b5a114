// The frames that the answerer saw, in a row.

import { html } from "../vendor/htm-preact.js";
import { useArtifact } from "../app/artifacts.js";
import { seconds } from "../app/words.js";

export function Shot({ sha256, alt, ...rest }) {
  const url = useArtifact(sha256);
  return url ? html`<img src=${url} alt=${alt} ...${rest} />` : html`<span class="no-picture" role="img" aria-label=${alt}></span>`;
}

function Row({ frames, label, player }) {
  return html`<div class="filmstrip" role="group" aria-label=${label}>
    ${frames.map((frame) => html`<button key=${frame.index} class=${frame.index === player.frame ? "shot on" : "shot"} onClick=${() => player.seek(frame.index)}
      aria-label=${`Go to frame ${frame.index}, ${seconds(frame.time)}`}>
      <${Shot} sha256=${frame.sha256} alt="" width=${frame.width} height=${frame.height} /><small>${seconds(frame.time)}</small></button>`)}
  </div>`;
}

export function Filmstrip({ simulation, player }) {
  return html`<div class="strips">
    <h2>Frames used for the answer</h2>
    <${Row} frames=${simulation.frames} label="Frames used for the answer" player=${player} />
    ${simulation.factual_frames.length > 0 && html`<h2>The same moments in the unchanged scene</h2>
      <${Row} frames=${simulation.factual_frames} label="The scene as it is" player=${player} />`}
  </div>`;
}
