// What was found, drawn over the picture: boxes, names, paths with their bands, contacts, futures.

import { html, useMemo } from "../vendor/htm-preact.js";
import { bandOf, lineOf, tipOf } from "../app/geometry.js";
import { placed } from "../app/labels.js";
import { encounterWords, seconds } from "../app/words.js";

/** Names of what is in the picture. */
export function Labels({ labels, unit, size }) {
  return html`<g class="names">${placed(labels, unit, size).map(({ text, kind, x, y, height }, place) =>
    html`<text key=${place} class=${`name ${kind}`} x=${x} y=${y + 0.78 * height} font-size=${13 * unit}>${text}</text>`)}</g>`;
}

/** The names of a world: {text, box, kind, below}; `isOld`: what happens in it is no longer so. */
export function labelsOf(trajectory, isOld) {
  const { bodies, fps } = trajectory;
  const encounters = isOld ? [] : trajectory.encounters;
  const met = new Set(encounters.map((encounter) => encounter.object));
  return [
    ...encounters.map((encounter) => ({
      text: `${encounterWords(encounter, trajectory)}, ${seconds(encounter.time ?? encounter.first_frame / fps)}`, box: encounter.bbox, kind: `met ${encounter.kind}`, below: true,
    })),
    ...bodies.slice(1).filter((body) => !met.has(body.object)).map((body) => ({ text: body.object, box: body.bbox, kind: "body" })),
  ];
}

export function Rect({ box, kind }) {
  return html`<rect class=${kind} x=${box[0]} y=${box[1]} width=${Math.max(0, box[2] - box[0])} height=${Math.max(0, box[3] - box[1])} />`;
}

/** A thing that the server sees: its outline, or a dashed box where that is not certain. */
export function Lit({ thing, size }) {
  if (!thing.light) return html`<${Rect} box=${thing.bbox} kind="lit unsure" />`;
  return html`<image class="lit" href=${thing.light.href} x="0" y="0" width=${size.width} height=${size.height} />`;
}

/** An arrow with a head. */
export function Arrow({ from, direction, size, unit }) {
  const tip = tipOf(from, direction, size);
  const [dx, dy] = direction;
  const [length, half] = [13 * unit, 7 * unit];
  const base = [tip[0] - dx * length, tip[1] - dy * length];
  const head = `M${tip}L${base[0] - dy * half} ${base[1] + dx * half}L${base[0] + dy * half} ${base[1] - dx * half}Z`;
  return html`<g class="arrow"><path class="halo" d=${`M${from}L${base}`} /><path class="line" d=${`M${from}L${base}`} /><path class="head" d=${head} /></g>`;
}

/** The world of a result as it is computed: what does not change while it plays. */
export function World({ simulation, unit, size, layers, line }) {
  const { trajectory } = simulation;
  return useMemo(() => html`<g class="world">
    ${layers.band && !line && trajectory.paths.map((path, place) => path.band.length > 0 && html`<path key=${place} class=${`band ${place ? "pushed" : ""}`} d=${bandOf(path, size)} />`)}
    ${layers.names && trajectory.bodies.slice(1).map((body, place) => html`<${Rect} key=${place} box=${body.bbox} kind="body" />`)}
    ${trajectory.encounters.map((encounter, place) => html`<${Rect} key=${place} box=${encounter.bbox} kind=${`met ${encounter.kind}`} />`)}
    ${layers.path && trajectory.paths.map((path, place) => {
      const d = place === 0 && line ? line : lineOf(path);
      return html`<g key=${place}><path class="halo" d=${d} /><path class=${`path ${place ? "pushed" : ""}`} d=${d} /></g>`;
    })}
    ${layers.path && !line && trajectory.contacts.map((contact, place) => html`<circle key=${place} class=${contact.b === null ? "contact floor" : "contact"}
      cx=${contact.point[0]} cy=${contact.point[1]} r=${4.5 * unit}><title>${`${seconds(contact.time)}: ${contact.b === null ? "meets the floor" : "meets another object"}`}</title></circle>`)}
  </g>`, [simulation, unit, layers, line, size.width, size.height]);
}

/** Where everything is at one frame, in the world that is shown and in some others. */
export function Moment({ simulation, frame, unit, layers, cutout }) {
  const { trajectory, grounding } = simulation;
  const [x0, y0, x1, y1] = grounding.bbox;
  const futures = layers.futures && frame > 0 ? trajectory.paths[0].futures ?? [] : [];
  const { band, points: [start] } = trajectory.paths[0];
  return html`<g class="moment">
    ${layers.band && frame > 0 && band[frame] && html`<${Rect} box=${band[frame]} kind="spread" />`}
    ${futures.map((points, place) => {
      const [x, y] = points[frame] ?? points.at(-1);
      return cutout
        ? html`<image key=${place} class="ghost" href=${cutout} x=${x0 + x - start[0]} y=${y0 + y - start[1]} width=${x1 - x0} height=${y1 - y0} />`
        : html`<rect key=${place} class="ghost" x=${x0 + x - start[0]} y=${y0 + y - start[1]} width=${x1 - x0} height=${y1 - y0} />`;
    })}
    ${layers.path && trajectory.paths.map((path, place) => path.visible[frame] && html`<circle key=${`at ${place}`} class=${`now ${place ? "pushed" : ""}`}
      cx=${path.points[frame][0]} cy=${path.points[frame][1]} r=${5 * unit} />`)}
  </g>`;
}
