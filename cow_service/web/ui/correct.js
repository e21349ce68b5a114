// What was read, as fields that can be corrected.

import { html } from "../vendor/htm-preact.js";
import { correct } from "../app/asking.js";
import { boxBetween, isBox, rounded } from "../app/geometry.js";
import { groundingOf, isDirected, motionOf, objectsOf } from "../app/request.js";
import { NOTHING_CORRECTED, set } from "../app/store.js";

const KINDS = { linear: "is pushed", projectile: "is thrown", fall: "falls freely", static: "stays where it is", place: "is put somewhere" };
const LAWS = { contact: "with floor and contacts", ballistic: "through everything" };

function Select({ label, value, options, onChange, disabled = false }) {
  return html`<label>${label}<select value=${value} disabled=${disabled} onChange=${(event) => onChange(event.target.value)}>
    ${Object.entries(options).map(([name, text]) => html`<option key=${name} value=${name} selected=${name === value}>${text}</option>`)}
  </select></label>`;
}

function motionOfKind(kind, motion) {
  if (!isDirected(kind)) return { kind, law: motion.law };
  const base = isDirected(motion.kind) ? motionOf(motion) : { direction: [1, 0] };
  const { distance, duration, until, steps, ...rest } = base;
  return { ...(kind === "linear" ? base : rest), kind, law: motion.law };
}

function Motion({ simulation, corrections }) {
  const { motion } = simulation;
  const scale = motion.metres_per_pixel.value;
  const change = (fields) => correct({ motion: { ...(corrections.motion ?? motionOf(motion)), ...fields }, trajectory: null });
  const kinds = Object.fromEntries(Object.entries(KINDS).filter(([kind]) => kind !== "place" || motion.kind === "place"));
  return html`<fieldset><legend>Motion</legend>
    <div class="fields">
      <${Select} label=${`The ${simulation.grounding.object}`} value=${motion.kind} options=${kinds} onChange=${(kind) => correct({ motion: motionOfKind(kind, motion), trajectory: null })} />
      <${Select} label="Law" value=${motion.law} options=${LAWS} onChange=${(law) => change({ law })} />
      ${isDirected(motion.kind) && html`<label>Speed, px/s <small>${(motion.speed * scale).toFixed(2)} m/s</small>
        <input type="number" min="0" max="100000" step="any" value=${rounded(motion.speed, 1)} onChange=${(event) => event.target.value !== "" && event.target.checkValidity()
          && change({ speed: Number(event.target.value), speed_deviation: 0 })} /></label>
      <label>Towards or away <small>${motion.depth > 0.05 ? "away from the camera" : motion.depth < -0.05 ? "towards the camera" : "along the picture"}</small>
        <input type="range" min="-0.95" max="0.95" step="0.05" value=${motion.depth} onChange=${(event) => change({ depth: Number(event.target.value), depth_deviation: 0 })} /></label>`}
    </div>
  </fieldset>`;
}

function Objects({ simulation, corrections, found, picture }) {
  const own = corrections.objects;
  const change = (place, fields) => correct({ objects: own.map((object, index) => (index === place ? { ...object, ...fields } : object)) });
  const bodies = simulation ? simulation.trajectory.bodies.slice(1) : found;
  const others = bodies.filter((body) => !own.some((object) => object.object === body.object));
  const removed = corrections.interventions.filter((each) => each.kind === "remove").map((each) => each.object);
  const remove = (body) => correct({
    objects: own.some((object) => object.object === body.object) ? own : [...own, { object: body.object, bbox: body.bbox, role: "target" }],
    interventions: [...corrections.interventions, { kind: "remove", object: body.object }],
  });
  return html`<fieldset><legend>Other objects</legend>
    <ul class="objects">
      ${own.map((object, place) => html`<li key=${`own ${place}`}>
        <input aria-label=${`Name of object ${place + 1}`} dir="auto" maxlength="200" value=${object.object} onChange=${(event) => event.target.value.trim() && change(place, { object: event.target.value.trim() })} />
        ${removed.includes(object.object) ? html`<small>taken away</small>` : html`<select aria-label=${`What ${object.object} is`} value=${object.role} onChange=${(event) => change(place, { role: event.target.value })}>
          <option value="target" selected=${object.role === "target"}>asked about</option><option value="obstacle" selected=${object.role === "obstacle"}>in the way</option></select>`}
        <button class="plain" aria-label=${`Forget ${object.object}`} onClick=${() => correct({
          objects: own.filter((_, index) => index !== place),
          interventions: corrections.interventions.filter((each) => each.object !== object.object),
        })}>✕</button>
      </li>`)}
      ${others.map((body, place) => html`<li key=${`found ${place}`}><span dir="auto">${body.object}</span>
        ${simulation && html`<button class="plain" onClick=${() => remove(body)}>Take away</button>`}</li>`)}
    </ul>
    ${!own.length && !others.length && html`<p class="hint">None was found.</p>`}
    <button type="button" onClick=${() => set({ tool: "object" })}>Draw an object</button>
    <${ByNumbers} corrections=${corrections} picture=${picture} />
  </fieldset>`;
}

/** A box given by its numbers: for people who do not drag. */
function ByNumbers({ corrections, picture }) {
  const submit = (event) => {
    event.preventDefault();
    const data = new FormData(event.target);
    const bbox = boxBetween([Number(data.get("x0")), Number(data.get("y0"))], [Number(data.get("x1")), Number(data.get("y1"))], picture);
    const object = data.get("name").trim();
    if (!isBox(bbox) || !object) return;
    if (data.get("what") === "mover") correct({ grounding: { object, bbox }, trajectory: null });
    else correct({ objects: [...corrections.objects, { object, bbox, role: data.get("what") }] });
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
  const corrected = JSON.stringify(corrections) !== JSON.stringify(NOTHING_CORRECTED);
  if (!simulation && !found.length && !corrected && !problem) return null;
  return html`<details class="correct" open=${!matchMedia("(max-width: 48rem)").matches}>
    <summary>What was read, to correct</summary>
    ${corrections.trajectory && html`<p class="hint">The path is yours. <button class="plain" onClick=${() => correct({ trajectory: null })}>Compute it again</button></p>`}
    ${simulation && html`<fieldset><legend>What moves</legend><div class="row">
      <input aria-label="Name of what moves" dir="auto" maxlength="200" value=${simulation.grounding.object} onChange=${(event) => event.target.value.trim()
        && correct({ objects: objectsOf(simulation.grounding, corrections.objects), grounding: { ...groundingOf(simulation.grounding), ...corrections.grounding, object: event.target.value.trim() } })} />
      <button onClick=${() => set({ tool: "mover" })}>Draw its box</button></div></fieldset>
      <${Motion} simulation=${simulation} corrections=${corrections} />`}
    <${Objects} simulation=${simulation} corrections=${corrections} found=${found} picture=${picture} />
    ${corrected && html`<button onClick=${() => correct(NOTHING_CORRECTED)}>Forget all corrections</button>`}
  </details>`;
}
