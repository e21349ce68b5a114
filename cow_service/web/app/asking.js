// What people do at the page: choose a picture, ask, correct, undo, cancel, open a job.

import { artifactAddress } from "./artifacts.js";
import { jobAddress, pageAddress } from "./address.js";
import { follow } from "./events.js";
import { requestOf, stateOf } from "./request.js";
import { call, callJson, newIdempotencyKey, persist, postJson } from "./server.js";
import { NOTHING_CORRECTED, get, set } from "./store.js";

const MOST_UNDONE = 50;
const LINE_SECONDS = 2; // between two looks at the place in the queue
let running = null; // the AbortController of the job that the page waits for

/** Shows whether the server is away. */
export const tellAway = (away) => {
  if (get().away !== away) set({ away });
};

/** What went wrong, as the page shows it; null for what somebody broke off. */
export function shownProblem(error) {
  if (error?.name === "AbortError") return null;
  if (error?.code) return error;
  console.error(error);
  return { code: "page-error", title: "The page made a mistake.", detail: String(error?.message ?? error), errors: [] };
}

/** Sends a request and returns its job. The picture is sent where the server does not keep it. */
async function submit(picture, kind, request, signal) {
  const headers = { Prefer: "respond-async", "Idempotency-Key": newIdempotencyKey() };
  const send = () => {
    if (picture.sha256) return postJson(`/${kind}`, { ...request, image: { artifact: picture.sha256 } }, headers, signal);
    const { question, ...rest } = request;
    const body = new FormData();
    body.append("image", picture.blob, "image");
    body.append("question", question);
    body.append("request", JSON.stringify(rest));
    return callJson(`/${kind}`, { method: "POST", body, headers, signal });
  };
  const sent = () => persist(send, tellAway, signal);
  try {
    return await sent();
  } catch (error) {
    if (error.code !== "artifact-not-found" || !picture.blob) throw error;
    picture = { ...picture, sha256: null };
    headers["Idempotency-Key"] = newIdempotencyKey();
    return sent();
  }
}

/** Follows a job to its end, then reads it with its result. `tell` hears of each event. */
async function ended(jobId, tell, signal) {
  await follow(jobId, tell, tellAway, signal);
  return persist(() => callJson(`/jobs/${jobId}`, { signal }), tellAway, signal);
}

/** {answer, simulation, problem} of a job that has ended. */
function outcomeOf(job) {
  const answer = job.kind === "answer" ? job.result : null;
  const simulation = job.kind === "answer" ? answer?.simulation ?? null : job.result;
  const problem = job.problem ?? answer?.simulation_problem ?? null;
  return { answer, simulation, problem: problem && { ...problem, code: problem.type.split(":").pop(), errors: problem.errors ?? [] } };
}

/** Reads the place in the queue, of which the events tell nothing. */
async function lookAtLine(id, signal) {
  if (get().run?.job.status !== "queued") return;
  const job = await callJson(`/jobs/${id}`, { signal }).catch(() => null); // the events tell what is wrong
  const { run } = get();
  if (job?.status === "queued" && run?.job.id === id) set({ run: { ...run, job } });
}

async function watch(job, settings, controller) {
  set({ run: { job, done: [] }, problem: null });
  const noted = (event, now) => {
    const { run } = get();
    if (run?.job.id !== job.id) return;
    set({ run: { job: now.id ? now : run.job, done: event === "stage" ? [...run.done, now.stage] : run.done } });
  };
  const line = setInterval(() => void lookAtLine(job.id, controller.signal), 1000 * LINE_SECONDS);
  const last = await ended(job.id, noted, controller.signal).finally(() => clearInterval(line));
  const { answer, simulation, problem } = outcomeOf(last);
  const { picture } = get();
  const image = (simulation ?? answer)?.image;
  if (picture && image) set({ picture: { ...picture, sha256: picture.sha256 ?? image.sha256 ?? null } });
  if (last.status === "succeeded") {
    set({ result: { jobId: job.id, kind: last.kind, answer, simulation, settings }, run: null, problem, tool: "select" });
  } else {
    set({ run: null, problem: last.status === "canceled" ? null : problem });
  }
}

function begin() {
  running?.abort();
  running = new AbortController();
  return running;
}

async function guarded(controller, work) {
  try {
    await work();
  } catch (error) {
    if (controller.signal.aborted) return;
    set({ run: null, problem: shownProblem(error) });
  }
}

/** Asks what is on the screen. The job before, if it has not ended, is canceled. */
export async function ask() {
  const { picture, question, settings, run } = get();
  if (!picture || !question.trim()) return;
  if (run?.job.id) void cancelJob(run.job.id);
  const controller = begin();
  set({ run: { job: { id: null, status: "sending", progress: 0, stage: null }, done: [] }, problem: null, compared: [] });
  await guarded(controller, async () => {
    const job = await submit(picture, settings.kind, requestOf(get()), controller.signal);
    history.pushState(null, "", jobAddress(job.id));
    await watch(job, settings, controller);
  });
  if (!controller.signal.aborted) forgetLook();
}

async function cancelJob(id) {
  try {
    await call(`/jobs/${id}/cancel`, { method: "POST" });
  } catch (error) {
    set({ problem: shownProblem(error) });
  }
}

/** Ends the job that the page waits for. */
export async function cancel() {
  const { run } = get();
  if (!run) return;
  if (run.job.id) await cancelJob(run.job.id);
  running?.abort();
  set({ run: null });
}

/** Changes corrections and asks again, if something was asked before. */
export function correct(change, { again = true } = {}) {
  const { corrections, past, result, problem } = get();
  const next = { ...corrections, ...change };
  set({ corrections: next, past: [...past, corrections].slice(-MOST_UNDONE), future: [], tool: "select" });
  if (again && (result || problem)) void ask();
}

function step(from, to) {
  const state = get();
  if (!state[from].length) return;
  const corrections = state[from].at(-1);
  set({ corrections, [from]: state[from].slice(0, -1), [to]: [...state[to], state.corrections] });
  if (state.result || state.problem) void ask();
}

export const undo = () => step("past", "future");
export const redo = () => step("future", "past");

export const changeSettings = (change) => set(({ settings }) => ({ settings: { ...settings, ...change } }));

/** Shows a picture that was dropped, pasted, chosen or photographed, and looks what is in it. */
export async function choosePicture(blob, name, question = "") {
  begin();
  const url = URL.createObjectURL(blob);
  const image = new Image();
  image.src = url;
  try {
    await image.decode();
  } catch {
    URL.revokeObjectURL(url);
    const detail = `“${name}” is no picture that the browser can show. Take a PNG, JPEG or WebP.`;
    set({ problem: { code: "not-a-picture", title: "That is no picture.", detail, errors: [] } });
    return;
  }
  forgetLook();
  const picture = { url, blob, sha256: null, width: image.naturalWidth, height: image.naturalHeight, name };
  const fresh = { corrections: NOTHING_CORRECTED, past: [], future: [], run: null, result: null, problem: null, compared: [], found: [] };
  set({ picture, question, tool: "select", view: "case", ...fresh });
  history.pushState(null, "", pageAddress());
  await look(picture);
}

let looked = null; // the job of `look`

/** Looks what is in a picture, for suggestions. Its job is removed once another one keeps the picture. */
async function look(picture) {
  // A mover of some pixels that stands still: what is found is all the rest.
  const request = {
    question: "What is in the picture?",
    grounding: { object: "corner", bbox: [0, 0, 3, 3] },
    motion: { kind: "static" },
    num_frames: 2, video: false, ensemble: 0, frames: { count: 1 }, generator: "cutout",
  };
  try {
    const job = await submit(picture, "simulate", request, undefined);
    looked = job.id;
    if (get().picture?.url !== picture.url || get().run || get().result) return forgetLook();
    const last = await ended(job.id, () => {}, undefined);
    const { simulation } = outcomeOf(last);
    const current = get().picture;
    if (!simulation || current?.url !== picture.url) return;
    set({ found: simulation.trajectory.bodies.slice(1), picture: { ...current, sha256: simulation.image.sha256 } });
  } catch (error) {
    if (error.code === "bad-image" || error.status === 413 || error.status === 415) set({ problem: error });
    // Else there are no suggestions: what is wrong with the server is told when something is asked.
  }
}

/** Removes the job of `look`: the picture is kept by the jobs that came after it. */
function forgetLook() {
  if (looked === null) return;
  const id = looked;
  looked = null;
  call(`/jobs/${id}`, { method: "DELETE" }).catch(() => {});
}

/** Shows a job as if it had been asked here. */
export async function openJob(id) {
  const controller = begin();
  set({ view: "case", run: { job: { id: null, status: "opening", progress: 0, stage: null }, done: [] }, problem: null, compared: [] });
  await guarded(controller, async () => {
    const { signal } = controller;
    const [job, accepted] = await persist(
      () => Promise.all([callJson(`/jobs/${id}`, { signal }), callJson(`/jobs/${id}/request`, { signal })]), tellAway, signal);
    const shown = stateOf(accepted.kind, accepted.request);
    const sha256 = accepted.request.image.artifact;
    const url = await artifactAddress(sha256);
    const image = new Image();
    image.src = url;
    await image.decode().catch(() => {});
    const size = { width: image.naturalWidth || 640, height: image.naturalHeight || 480 };
    const picture = { url, blob: null, sha256, ...size, name: "image" };
    const { answer, simulation, problem } = outcomeOf(job);
    const result = job.status === "succeeded" ? { jobId: id, kind: job.kind, answer, simulation, settings: shown.settings } : null;
    set({ ...shown, picture, result, past: [], future: [], found: [], tool: "select", run: null, problem });
    if (job.status === "queued" || job.status === "running") await watch(job, shown.settings, controller);
  });
}

/** Asks the same of another reader or generator, beside what is shown. */
export async function compareWith(change) {
  const { picture, settings, result } = get();
  const label = Object.values(change).join(", ");
  const other = { ...settings, ...change };
  const put = (entry) =>
    set(({ compared }) => ({ compared: [...compared.filter((each) => each.label !== label), { label, ...entry }] }));
  put({ status: "running" });
  const { signal } = running ?? begin();
  try {
    const job = await submit(picture, other.kind, requestOf({ ...get(), settings: other }), signal);
    const { answer, simulation, problem } = outcomeOf(await ended(job.id, () => {}, signal));
    if (get().result === result) put({ status: answer || simulation ? "succeeded" : "failed", jobId: job.id, answer, simulation, problem });
  } catch (error) {
    if (!signal.aborted) put({ status: "failed", problem: shownProblem(error) });
  }
}

/** Reads what the server has; later questions do not wait for it. */
export async function loadModels() {
  try {
    set({ models: await persist(() => callJson("/models"), tellAway) });
  } catch (error) {
    set({ problem: shownProblem(error) });
  }
}
