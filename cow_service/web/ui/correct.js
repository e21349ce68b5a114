// What was read, as fields that can be corrected.

import { html } from "../vendor/htm-preact.js";
import { correct } from "../app/asking.js";
import { boxBetween, isBox, isSameBox, rounded } from "../app/geometry.js";
import { correctedWords, freeName, isDirected, motionWith, moverWith } from "../app/corrections.js";
import { set } from "../app/store.js";

const KINDS = { linear: "is pushed", projectile: "is thrown", fall: "falls freely", static: "stays where it is", place: "is put somewhere" };
const LAWS = { contact: "with floor and contacts", ballistic: "through everything" };

function Select({ label, value, options, onChange, disabled = false }) {
  return html`<label>${label}<select value=${value} disabled=${disabled} onChange=${(event) => onChange(event.target.value)}>
    ${Object.entries(options).map(([name, text]) => html`<option key=${name} value=${name} selected=${name === value}>${text}</option>`)}
  </select></label>`;
}

/** The angle of a direction in the image, degrees: 0 to the right, 90 up. */
const degreesOf = ([dx, dy]) => Math.round((Math.atan2(-dy, dx) * 180) / Math.PI);
const towards = (degrees) => [Math.cos, (angle) => -Math.sin(angle)].map((part) => rounded(part((degrees * Math.PI) / 180), 4));

/** A number field that tells only what can be taken. */
function Quantity({ label, note = "", value, onNumber, ...rest }) {
  return html`<label>${label} ${note && html`<small>${note}</small>`}<input type="number" step="any" value=${value} ...${rest}
    onChange=${(event) => event.target.value !== "" && event.target.checkValidity() && onNumber(Number(event.target.value))} /></label>`;
}

function Motion({ simulation, corrections }) {
  const motion = { direction: null, depth: 0, kind: "linear", law: "contact", speed: null, ...simulation?.motion, ...corrections.motion };
  const scale = simulation?.motion.metres_per_pixel.value;
  const change = (fields) => correct({ motion: motionWith(simulation, corrections, fields), trajectory: null });
  const kinds = Object.fromEntries(Object.entries(KINDS).filter(([kind]) => kind !== "place" || motion.kind === "place"));
  return html`<fieldset><legend>Motion</legend>
    <div class="fields">
      <${Select} label=${simulation ? `The ${simulation.grounding.object}` : "What moves"} value=${motion.kind} options=${kinds} onChange=${(kind) => change({ kind })} />
      <${Select} label="Law" value=${motion.law} options=${LAWS} onChange=${(law) => change({ law })} />
      ${isDirected(motion.kind) && html`<${Quantity} label="Direction, degrees" note="0 right, 90 up" value=${motion.direction ? degreesOf(motion.direction) : ""} min="-360" max="360"
        onNumber=${(degrees) => change({ direction: towards(degrees) })} />`}
      ${isDirected(motion.kind) && simulation && html`<${Quantity} label="Speed, px/s" note=${`${(motion.speed * scale).toFixed(2)} m/s`} value=${rounded(motion.speed ?? 0, 1)} min="0" max="100000"
        onNumber=${(speed) => change({ speed, speed_deviation: 0 })} />
      <label>Towards or away <small>${motion.depth > 0.05 ? "away from the camera" : motion.depth < -0.05 ? "towards the camera" : "along the picture"}</small>
        <input type="range" min="-0.95" max="0.95" step="0.05" value=${motion.depth} onChange=${(event) => change({ depth: Number(event.target.value), depth_deviation: 0 })} /></label>`}
    </div>
  </fieldset>`;
}

function Objects({ simulation, corrections, found, picture }) {
  const { objects: own, interventions } = corrections;
  const changed = (place, fields) => own.map((object, index) => (index === place ? { ...object, ...fields } : object));
  const rename = (place, name) => {
    const free = freeName(name, own.filter((_, index) => index !== place));
    const renamed = (words) => (words === own[place].object ? free : words);
    correct({
      objects: changed(place, { object: free }),
      interventions: interventions.map((each) => ({ ...each, object: renamed(each.object), ...(each.targets ? { targets: each.targets.map(renamed) } : {}) })),
    });
  };
  const bodies = simulation ? simulation.trajectory.bodies.slice(1) : found;
  const others = bodies.filter((body) => !own.some((object) => isSameBox(object.bbox, body.bbox)));
  const removed = interventions.filter((each) => each.kind === "remove").map((each) => each.object);
  const remove = (body) => {
    const object = freeName(body.object, own);
    correct({ objects: [...own, { object, bbox: body.bbox, role: "target" }], interventions: [...interventions, { kind: "remove", object }] });
  };
  return html`<fieldset><legend>Other objects</legend>
    <ul class="objects">
      ${own.map((object, place) => html`<li key=${`own ${place}`}>
        <input aria-label=${`Name of object ${place + 1}`} dir="auto" maxlength="200" value=${object.object} onChange=${(event) => event.target.value.trim() && rename(place, event.target.value.trim())} />
        ${removed.includes(object.object) ? html`<small>taken away</small>` : html`<select aria-label=${`What ${object.object} is`} value=${object.role} onChange=${(event) => correct({ objects: changed(place, { role: event.target.value }) })}>
          <option value="target" selected=${object.role === "target"}>asked about</option><option value="obstacle" selected=${object.role === "obstacle"}>in the way</option></select>`}
        <button class="plain" aria-label=${`Remove ${object.object}`} onClick=${() => correct({
          objects: own.filter((_, index) => index !== place),
          interventions: interventions.filter((each) => each.object !== object.object && !each.targets?.includes(object.object)),
        })}>✕</button>
      </li>`)}
      ${others.map((body, place) => html`<li key=${`found ${place}`}><span dir="auto">${body.object}</span>
        ${simulation && html`<button class="plain" onClick=${() => remove(body)}>Take away</button>`}</li>`)}
    </ul>
    ${!own.length && !others.length && html`<p class="hint">None was found.</p>`}
    <button type="button" onClick=${() => set({ tool: "object" })}>Draw an object</button>
    <${ByNumbers} simulation=${simulation} corrections=${corrections} picture=${picture} />
  </fieldset>`;
}

/** A box given by its numbers: for people who do not drag. */
function ByNumbers({ simulation, corrections, picture }) {
  const submit = (event) => {
    event.preventDefault();
    const data = new FormData(event.target);
    const bbox = boxBetween([Number(data.get("x0")), Number(data.get("y0"))], [Number(data.get("x1")), Number(data.get("y1"))], picture);
    const object = data.get("name").trim();
    if (!isBox(bbox) || !object) return;
    if (data.get("what") === "mover") correct(moverWith(simulation, corrections, { object, bbox }));
    else correct({ objects: [...corrections.objects, { object: freeName(object, corrections.objects), bbox, role: data.get("what") }] });
    event.target.reset();
  };
  const number = (name, label, most) => html`<label>${label}<input name=${name} type="number" min="0" max=${most} step="any" required /></label>`;
  return html`<details class="numbers"><summary>Give a box by its numbers</summary>
    <form onSubmit=${submit}><div class="fields">
      <label>Name<input name="name" required maxlength="200" dir="auto" /></label>
      <label>What it is<select name="what"><option value="obstacle">in the way</option><option value="target">asked about</option><option value="mover">what moves</option></select></label>
      ${number("x0", "Left, px", picture.width)}${number("y0", "Top, px", picture.height)}
      ${number("x1", "Right, px", picture.width)}${number("y1", "Bottom, px", picture.height)}
    </div><button>Add the box</button></form></details>`;
}

export function Correct({ state }) {
  const { result, corrections, found, picture, problem } = state;
  const simulation = result?.simulation ?? null;
  const corrected = correctedWords(corrections) !== "";
  if (!simulation && !found.length && !corrected && !problem) return null;
  return html`<details class="correct" open=${!matchMedia("(max-width: 48rem)").matches}>
    <summary>Correct what was read</summary>
    ${corrections.trajectory && html`<p class="hint">You changed the path. <button class="plain" onClick=${() => correct({ trajectory: null })}>Compute it again</button></p>`}
    ${simulation && html`<fieldset><legend>What moves</legend><div class="row">
      <input aria-label="Name of the moving object" dir="auto" maxlength="200" value=${corrections.grounding?.object ?? simulation.grounding.object} onChange=${(event) => event.target.value.trim()
        && correct(moverWith(simulation, corrections, { object: event.target.value.trim() }))} />
      <button onClick=${() => set({ tool: "mover" })}>Draw its box</button></div></fieldset>`}
    ${(simulation || corrections.grounding || problem) && html`<${Motion} simulation=${simulation} corrections=${corrections} />`}
    <${Objects} simulation=${simulation} corrections=${corrections} found=${found} picture=${picture} />
  </details>`;
}
