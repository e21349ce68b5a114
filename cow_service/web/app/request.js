// The body of POST /simulate and POST /answer, made of what is on the screen, and the other way round.

import { DEFAULT_SETTINGS } from "./store.js";

const same = (a, b) => JSON.stringify(a) === JSON.stringify(b);

/** Answers to choose from, one on each line. */
const choicesOf = (text) => text.split("\n").map((line) => line.trim()).filter(Boolean);

const CORRECTED = ["grounding", "motion", "trajectory", "camera"];
const LISTS = ["objects", "interventions"];
const OF_CLIP = ["num_frames", "fps", "ensemble", "generator_options"];
const SETTINGS = ["reader", "generator", "imagine", "votes", "seed", "frames", "video", ...OF_CLIP];

/** A thing by its mask alone, where it has one: a request takes no box beside it, which the page shows. */
const placed = ({ mask, bbox, ...rest }) => ({ ...rest, ...(mask ? { mask } : bbox ? { bbox } : {}) });

/** The request without its image. Fields that have the server's default are left out. */
export function requestOf({ question, settings, corrections }) {
  const answering = settings.kind === "answer";
  const request = { question, ...settings.rest };
  const choices = choicesOf(settings.choices);
  if (choices.length && !request.options) request.options = choices;
  for (const name of CORRECTED) if (corrections[name]) request[name] = corrections[name];
  for (const name of LISTS) if (corrections[name].length) request[name] = corrections[name];
  if (request.grounding) request.grounding = placed(request.grounding);
  if (request.objects) request.objects = request.objects.map(placed);
  for (const name of ["reader", "generator"]) if (settings[name]) request[name] = settings[name];
  for (const name of OF_CLIP) if (!same(settings[name], DEFAULT_SETTINGS[name])) request[name] = settings[name];
  if (settings.seed !== null) request.seed = settings.seed;
  if (!same(settings.frames, {})) request.frames = settings.frames;
  if (settings.video !== !answering) request.video = settings.video; // the server's default: of simulations alone
  if (answering) {
    if (settings.baseline) request.baseline = true;
    if (settings.votes !== 1) request.votes = settings.votes;
    if (settings.imagine !== "always") request.imagine = settings.imagine;
  }
  return request;
}

/** Question, settings and corrections of a request that was accepted earlier. */
export function stateOf(kind, { question, image, options, baseline, live, ...request }) {
  const settings = { ...DEFAULT_SETTINGS, kind, baseline: baseline ?? false, frames: {}, video: kind !== "answer", rest: {} };
  const corrections = {};
  for (const name of CORRECTED) corrections[name] = request[name] ?? null;
  for (const name of LISTS) corrections[name] = request[name] ?? [];
  if (request.interventions?.length === 0) settings.rest.interventions = []; // nothing is changed, whatever the question says
  for (const [name, value] of Object.entries(request)) {
    if (SETTINGS.includes(name)) settings[name] = value;
    else if (!(name in corrections)) settings.rest[name] = value; // what the page has no field for
  }
  if (options) {
    settings.rest.options = options;
    settings.choices = options.map((option) => option.text ?? option).join("\n");
  }
  return { question, settings, corrections };
}
