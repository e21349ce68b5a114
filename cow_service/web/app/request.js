// The body of POST /simulate and POST /answer, made of what is on the screen; and corrections made of results.

import { DEFAULT_SETTINGS } from "./store.js";

const DIRECTED = new Set(["linear", "projectile"]);
const same = (a, b) => JSON.stringify(a) === JSON.stringify(b);

/** Answers to choose from, one on each line. */
export const choicesOf = (text) => text.split("\n").map((line) => line.trim()).filter(Boolean);

/** The request without its image. Fields that have the server's default are left out. */
export function requestOf({ question, settings, corrections }) {
  const request = { question };
  const choices = choicesOf(settings.choices);
  if (choices.length) request.options = choices;
  for (const name of ["grounding", "motion", "trajectory", "camera"]) if (corrections[name]) request[name] = corrections[name];
  for (const name of ["objects", "interventions"]) if (corrections[name].length) request[name] = corrections[name];
  for (const name of ["reader", "generator"]) if (settings[name]) request[name] = settings[name];
  for (const name of ["num_frames", "fps", "ensemble", "generator_options"])
    if (!same(settings[name], DEFAULT_SETTINGS[name])) request[name] = settings[name];
  if (settings.seed !== null) request.seed = settings.seed;
  request.frames = settings.frames;
  if (settings.kind === "answer") {
    request.video = true;
    if (settings.baseline) request.baseline = true;
    if (settings.votes !== 1) request.votes = settings.votes;
    if (settings.imagine !== "always") request.imagine = settings.imagine;
  }
  return request;
}

/** Settings, corrections and question of a request that was accepted earlier. */
export function stateOf(kind, request) {
  const settings = { ...DEFAULT_SETTINGS, kind, baseline: request.baseline ?? false };
  const known = ["reader", "generator", "imagine", "votes", "num_frames", "fps", "ensemble", "seed", "frames", "generator_options"];
  for (const name of known) if (request[name] !== undefined && request[name] !== null) settings[name] = request[name];
  settings.choices = (request.options ?? []).map((option) => option.text ?? option).join("\n");
  const corrections = {
    grounding: request.grounding ?? null,
    motion: request.motion ?? null,
    trajectory: request.trajectory ?? null,
    objects: request.objects ?? [],
    interventions: request.interventions ?? [],
    camera: request.camera ?? null,
  };
  return { question: request.question, settings, corrections };
}

/** A motion as a request gives it, from what a result says of it. */
export function motionOf(motion) {
  const given = { kind: motion.kind, law: motion.law };
  if (DIRECTED.has(motion.kind)) {
    Object.assign(given, { direction: motion.direction, speed: motion.speed });
    if (motion.depth) given.depth = motion.depth;
    if (motion.depth_deviation) given.depth_deviation = motion.depth_deviation;
    if (motion.speed_deviation) given.speed_deviation = motion.speed_deviation;
  }
  if (motion.kind === "linear") {
    for (const name of ["distance", "duration", "until"]) if (motion[name] !== null) given[name] = motion[name];
    if (motion.steps.length) given.steps = motion.steps.map(withoutNulls);
  }
  if (motion.others.length) {
    given.others = motion.others.map(({ object, kind, direction, depth, speed }) =>
      withoutNulls(kind === "fall" ? { object: object.object, kind } : { object: object.object, kind, direction, depth, speed }));
  }
  if (motion.metres_per_pixel.source === "request") given.metres_per_pixel = motion.metres_per_pixel.value;
  return given;
}

/** Where the mover is as a request gives it, from what a result says of it. */
export function groundingOf(grounding) {
  const place = grounding.mask ? { mask: { artifact: grounding.mask.sha256 } } : { bbox: grounding.bbox };
  return { object: grounding.object, ...place };
}

/** The objects of a request whose mover is given: the reader, who knew what the question names, is not asked then. */
export function objectsOf(grounding, own) {
  const names = new Set(own.map((object) => object.object));
  const others = grounding.others.filter((other) => !names.has(other.object));
  return [...own, ...others.map(({ object, bbox, role }) => ({ object, bbox, role }))];
}

/** The role of an object that was drawn: the question asks about what it names. */
export function roleOf(name, question) {
  return question.toLowerCase().includes(name.toLowerCase().trim()) ? "target" : "obstacle";
}

const withoutNulls = (record) => Object.fromEntries(Object.entries(record).filter(([, value]) => value !== null));

export const isDirected = (kind) => DIRECTED.has(kind);
