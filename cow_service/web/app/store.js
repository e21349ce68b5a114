// What the page shows, in one place. Parts of the page get what they need of it as properties.

import { useEffect, useState } from "../vendor/htm-preact.js";

export const NOTHING_CORRECTED = Object.freeze({
  grounding: null,
  motion: null,
  trajectory: null,
  objects: [],
  interventions: [],
  camera: null,
});

export const DEFAULT_SETTINGS = Object.freeze({
  kind: "answer",
  reader: "",
  generator: "",
  imagine: "always",
  baseline: true,
  votes: 1,
  choices: "",
  num_frames: 81,
  fps: 16,
  frames: {},
  video: true,
  ensemble: 50,
  seed: null,
  generator_options: {},
  rest: {}, // fields of an opened job that the page has no control for
});

let state = {
  view: "case", // or "jobs"
  models: null, // GET /models
  picture: null, // {url, blob, sha256, width, height, name}
  found: [], // names of what was found in the picture before anything was asked
  question: "",
  settings: DEFAULT_SETTINGS,
  corrections: NOTHING_CORRECTED,
  past: [],
  future: [],
  tool: "select", // or "mover", "object", "direction"
  blind: false, // a look at the picture failed: boxes are drawn
  lit: null, // {things, others} under the pointer; the first one is lit: [{bbox, mask, score, name, light}]
  named: new Map(), // a question: the things that it names
  taken: null, // the thing that was chosen last as what moves
  run: null, // {job, done: [stages], settings} while a job is in the making
  result: null, // {jobId, kind, answer, simulation, settings, asked} of the last job that succeeded
  before: null, // the result before that one, of the same picture
  compared: [], // shown next to the result: by another reader or generator, or the previous one
  isForeseeing: false, // while dragging: the result is from another world
  problem: null,
  away: false,
  keyWanted: null, // {reason, answer}
};

const listeners = new Set();

export const get = () => state;

/** Changes some fields; a function is given the state before. */
export function set(change) {
  state = { ...state, ...(typeof change === "function" ? change(state) : change) };
  for (const listener of listeners) listener();
}

/** The state, for the outermost part of the page. */
export function useStore() {
  const [shown, show] = useState(state);
  useEffect(() => {
    const listener = () => show(state);
    listeners.add(listener);
    listener();
    return () => listeners.delete(listener);
  }, []);
  return shown;
}
