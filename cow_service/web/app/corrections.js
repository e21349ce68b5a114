// Corrections as a request takes them, made of what a result says and of corrections that were made before.

import { isSameBox } from "./geometry.js";
import { CORRECTED } from "./words.js";

const DIRECTED = new Set(["linear", "projectile"]);
const SET_MOVING = new Set(["linear", "projectile", "fall"]); // kinds of motion that others may have
const OF_ALL = ["kind", "law", "others", "metres_per_pixel"];
const OF_DIRECTED = [...OF_ALL, "direction", "depth", "depth_deviation", "speed", "speed_deviation"];
const OF_LINEAR = [...OF_DIRECTED, "distance", "duration", "until", "steps", "rises"];

export const isDirected = (kind) => DIRECTED.has(kind);

const present = (record) => Object.fromEntries(Object.entries(record).filter(([, value]) => value !== null && value !== undefined));
const DEFAULTS = { depth: 0, depth_deviation: 0, rises: false };
const isDefault = (name, value) => (Array.isArray(value) && !value.length) || DEFAULTS[name] === value;
const only = (record, names) => present(Object.fromEntries(names.filter((name) => !isDefault(name, record[name])).map((name) => [name, record[name]])));
const plain = (words) => words.toLowerCase().trim();

/** The motion that a result has, as a request gives it. */
export function motionOf(motion) {
  const others = motion.others.filter((other) => SET_MOVING.has(other.kind)).map(({ object, kind, direction, depth, speed }) =>
    kind === "fall" ? { object: object.object, kind } : { object: object.object, kind, direction, depth, speed });
  const given = { ...motion, others, steps: motion.steps.map(present), metres_per_pixel: null };
  if (motion.metres_per_pixel.source === "request") given.metres_per_pixel = motion.metres_per_pixel.value;
  return given;
}

/** The motion of a request in which some fields are others: a kind takes only the fields that it knows. */
export function motionWith(simulation, corrections, change) {
  const base = { ...(simulation ? motionOf(simulation.motion) : {}), ...corrections.motion, ...change };
  const kind = base.kind ?? "linear";
  if (!isDirected(kind)) return only({ ...base, kind }, OF_ALL);
  return only({ ...base, kind, direction: base.direction ?? [1, 0] }, kind === "linear" ? OF_LINEAR : OF_DIRECTED);
}

/** The motion of a request with another direction. */
export function motionTowards(simulation, corrections, direction) {
  const kind = corrections.motion?.kind ?? simulation?.motion.kind;
  const depth = corrections.motion?.depth ?? simulation?.motion.depth ?? 0;
  const change = { direction, kind: isDirected(kind) ? kind : "linear" };
  return motionWith(simulation, corrections, Math.abs(depth) > 0.95 ? { ...change, depth: 0 } : change);
}

function priorOf(prior) {
  return prior ? present({ shape: prior.shape, size: prior.size?.value, stands_on: prior.stands_on }) : {};
}

/** Where the mover of a result is, as a request gives it. */
export function groundingOf(grounding) {
  const place = grounding.mask ? { mask: { artifact: grounding.mask.sha256 } } : { bbox: grounding.bbox };
  return { object: grounding.object, ...place, ...priorOf(grounding.prior) };
}

/** The role of an object that was drawn: the question asks about what it names. */
export const roleOf = (name, question) => (plain(question).includes(plain(name)) ? "target" : "obstacle");

/** Objects that a result knows, beside those of the corrections; each has a name of its own. */
function objectsBeside({ grounding }, own) {
  const changed = grounding.interventions.flatMap((each) => [each.object, ...each.targets]);
  const names = new Set([grounding.object, ...own.map((object) => object.object)].map(plain));
  const objects = [...own];
  for (const { object, bbox, role, prior } of [...grounding.others, ...changed]) {
    if (names.has(plain(object)) || objects.some((known) => isSameBox(known.bbox, bbox)) || isSameBox(grounding.bbox, bbox)) continue;
    names.add(plain(object));
    objects.push({ object, bbox, role: role ?? "target", ...priorOf(prior) });
  }
  return objects;
}

/** Interventions that a result has, the question's among them, beside those of the corrections. */
function interventionsBeside({ grounding }, own) {
  const key = (each) => `${each.kind} ${plain(each.object)}`;
  const known = new Set(own.map(key));
  const found = grounding.interventions.map(({ kind, object, relation, targets }) =>
    kind === "place" ? { kind, object: object.object, relation, targets: targets.map((target) => target.object) } : { kind, object: object.object });
  return [...own, ...found.filter((each) => !known.has(key(each)))];
}

/** What the reader knew of the picture: it is not asked where the mover is given. */
export function knownBeside(simulation, corrections) {
  if (!simulation) return {};
  return {
    objects: objectsBeside(simulation, corrections.objects),
    interventions: interventionsBeside(simulation, corrections.interventions),
  };
}

/** Corrections with the mover elsewhere ({bbox}, also with its {mask}, or {point}), or by another name ({object}). */
export function moverWith(simulation, corrections, change) {
  const { bbox, point, mask, ...rest } = corrections.grounding ?? (simulation ? groundingOf(simulation.grounding) : {});
  const place = change.bbox || change.point ? {} : present({ bbox, point, mask });
  return { ...knownBeside(simulation, corrections), grounding: { ...rest, ...place, ...change }, trajectory: null };
}

/** A name that no other object has. */
export function freeName(name, objects) {
  const taken = new Set(objects.map((object) => plain(object.object)));
  for (let number = 2, free = name; ; number += 1) {
    if (!taken.has(plain(free))) return free;
    free = `${name} ${number}`;
  }
}


/** What was corrected, in words; empty where nothing was. */
export function correctedWords(corrections) {
  const named = Object.entries(CORRECTED).filter(([name]) => corrections[name] && !Array.isArray(corrections[name])).map(([, words]) => words);
  if (corrections.objects.length) named.push(corrections.objects.length === 1 ? "an object" : `${corrections.objects.length} objects`);
  if (corrections.interventions.length) named.push("what is changed before");
  return named.join(", ");
}
