// Numbers, times and states in words.

export const percent = (share) => `${Math.round(100 * share)}%`;
export const seconds = (value) => (value < 10 ? `${value.toFixed(1)} s` : `${Math.round(value)} s`);
export const plural = (count, one, many = `${one}s`) => `${count} ${count === 1 ? one : many}`;

export const MEETS = { touches: "hits", occludes: "passes in front of", "occluded-by": "passes behind" };

/** What a request can give instead of the reader, as the page calls it. */
export const CORRECTED = { grounding: "what moves", motion: "its motion", trajectory: "its path", camera: "the camera", objects: "other objects", interventions: "what is changed before" };

/** In their order, as `records/stages.py` has them; without those that run beside others. */
export const STAGES = {
  gating: "First answers",
  grounding: "Find the object",
  depth: "Measure the depth",
  motion: "Read the motion",
  trajectory: "Simulate the motion",
  generation: "Make the frames",
  answering: "Look and answer",
};

export const SIMULATE_STAGES = ["grounding", "motion", "trajectory", "generation"];

/** The stages of a request, in their order; servers with a depth model have that of the depth, too. */
export function stagesOf(settings) {
  if (settings.kind !== "answer") return SIMULATE_STAGES;
  const stages = settings.imagine === "never" ? [] : SIMULATE_STAGES;
  return [...(settings.imagine === "auto" ? ["gating"] : []), ...stages, "answering"];
}

export const DOUBTS = {
  speed: "how fast it moves",
  heading: "which way it heads in depth",
  camera: "how the camera stands",
  size: "how large things are",
  place: "where things are in depth",
  friction: "how much the floor slows things down",
  outline: "where the outlines of things run",
  identity: "whether the things are the ones that the question names",
  reading: "whether the question and the image were read rightly",
  faint: "whether something that could not be made out for certain stands in the way",
  depth: "whether the depth map shows what matters",
};

/** An answer in words. */
export function answerWords(verdict) {
  if (verdict.answer === null) return "Not sure";
  return verdict.option ? `${verdict.answer}: ${verdict.option}` : verdict.answer;
}

export function encounterWords(encounter, trajectory) {
  const who = encounter.subject === 0 ? "" : `${trajectory.bodies[encounter.subject]?.object ?? "another"} `;
  const sure = encounter.probability === null ? "" : `, ${percent(encounter.probability)}`;
  return `${who}${MEETS[encounter.kind] ?? encounter.kind} ${encounter.object}${sure}`;
}

/** What so many worlds say: {agreeing, text} of {yes, count, isSure}, and `first` where it is asked what is met first. */
export function shareWords({ yes, count, first, isSure }, trajectory) {
  const agreeing = first === undefined ? Math.max(yes, count - yes) : yes;
  const name = first === undefined ? (2 * yes >= count ? "Yes" : "No") : first < 0 ? "Nothing" : trajectory.bodies[first]?.object ?? "It";
  const says = `${agreeing} of ${plural(count, "simulated version")}`;
  return { agreeing, text: isSure ? `${name}: ${says}` : `Not sure: ${says} say ${name.toLowerCase()}` };
}

/** The time of a job, for people. */
export function when(time) {
  const then = new Date(time);
  const today = then.toDateString() === new Date().toDateString();
  return today ? then.toLocaleTimeString() : then.toLocaleString();
}

const NAME_IT = "Draw a box around the moving object: choose “What moves” above the picture, or name it as the picture shows it.";

const REMEDIES = {
  "object-not-found": NAME_IT,
  "cannot-ground": "Draw a box around the moving object: choose “What moves” above the picture.",
  "cannot-read-direction": "Draw the direction: choose “Direction” above the picture, and drag from the object to where it goes.",
  "artifact-not-found": "The picture is no longer kept by the server. Choose it again.",
  "job-not-found": "It was deleted, or belongs to another key.",
};

/** What a person at this page can do about a problem; empty where its detail says all. */
export const remedyOf = (problem) => REMEDIES[problem.code] ?? "";
