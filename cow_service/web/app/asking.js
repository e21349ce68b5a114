// What people do at the page: choose a picture, ask, correct, undo, cancel, open a job, compare.

import { artifactAddress, forgetArtifacts } from "./artifacts.js";
import { jobAddress, pageAddress } from "./address.js";
import { follow } from "./events.js";
import { forgetKey } from "./keys.js";
import { sendable } from "./pixels.js";
import { requestOf, stateOf } from "./request.js";
import { Problem, call, callJson, codeOf, newIdempotencyKey, persist, postJson } from "./server.js";
import { NOTHING_CORRECTED, get, set } from "./store.js";

const MOST_UNDONE = 50;
const LINE_SECONDS = 2; // between two looks at the place in the queue
const JOB_ID = /^[A-Za-z0-9-]{1,64}$/;
const NOTHING_SEEN = { blind: false, lit: null, named: new Map(), taken: null };
const NOTHING_ASKED = Object.freeze({ run: null, result: null, before: null, problem: null, compared: [], past: [], future: [], tool: "select", ...NOTHING_SEEN });

let running = new AbortController(); // of what the page waits for

/** Shows whether the server is away. */
export const tellAway = (away) => {
  if (get().away !== away) set({ away });
};

/** What went wrong, as the page shows it; null for a request that was canceled. */
export function shownProblem(error) {
  if (error?.name === "AbortError") return null;
  if (error?.code) return error;
  console.error(error);
  return { code: "page-error", title: "The page has an error.", detail: String(error?.message ?? error), errors: [] };
}

/** Ends what the page waits for, its job too, and begins anew. */
function begin() {
  const { run } = get();
  if (run?.job.id && run.cancels) void cancelJob(run.job.id);
  running.abort();
  running = new AbortController();
  return running;
}

async function cancelJob(id) {
  try {
    await call(`/jobs/${id}/cancel`, { method: "POST" });
  } catch (error) {
    if (error.code !== "job-not-found") set({ problem: shownProblem(error) });
  }
}

/** Sends a request and returns its job. The picture is sent where the server does not keep it.

A request that was sent is not aborted: an abort meanwhile cancels its job. */
async function submit(picture, kind, request, signal) {
  const headers = { Prefer: "respond-async", "Idempotency-Key": newIdempotencyKey() };
  const wanted = { ...request, live: true }; // so that the world moves while dragging
  const send = () => {
    if (picture.sha256) return postJson(`/${kind}`, { ...wanted, image: { artifact: picture.sha256 } }, headers);
    const { question, ...rest } = wanted;
    const body = new FormData();
    body.append("image", picture.blob, "image");
    body.append("question", question);
    body.append("request", JSON.stringify(rest));
    return callJson(`/${kind}`, { method: "POST", body, headers });
  };
  const sent = async () => {
    const job = await persist(send, tellAway, signal);
    if (!signal?.aborted) return job;
    await cancelJob(job.id);
    throw signal.reason;
  };
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
  return { answer, simulation, problem: problem && { ...problem, code: codeOf(problem), errors: problem.errors ?? [] } };
}

/** Reads the place in the queue, which the events do not report. */
async function lookAtLine(id, signal) {
  if (get().run?.job.status !== "queued") return;
  const job = await callJson(`/jobs/${id}`, { signal }).catch(() => null); // the events tell what is wrong
  const { run } = get();
  if (job?.status === "queued" && run?.job.id === id) set({ run: { ...run, job } });
}

/** Shows a job until it has ended, then its result. `asked` is what it was asked: {question, settings, corrections}. */
async function watch(job, asked, signal, cancels) {
  set({ run: { job, done: [], settings: asked.settings, cancels }, problem: null });
  const noted = (event, now) => {
    const { run } = get();
    if (signal.aborted || run?.job.id !== job.id) return;
    set({ run: { ...run, job: now.id ? now : run.job, done: event === "stage" ? [...run.done, now.stage] : run.done } });
  };
  const line = setInterval(() => void lookAtLine(job.id, signal), 1000 * LINE_SECONDS);
  const last = await ended(job.id, noted, signal).finally(() => clearInterval(line));
  if (signal.aborted) return;
  const { answer, simulation, problem } = outcomeOf(last);
  const { picture } = get();
  const sha256 = picture?.sha256 ?? (simulation ?? answer)?.image.sha256 ?? null;
  if (picture && !picture.sha256 && sha256) set({ picture: { ...picture, sha256 } });
  if (last.status === "succeeded") {
    set({ result: { jobId: job.id, kind: last.kind, answer, simulation, settings: asked.settings, asked }, before: get().result, run: null, problem });
  } else {
    set({ run: null, problem: last.status === "canceled" ? null : problem });
  }
}

async function guarded(signal, work) {
  try {
    await work();
  } catch (error) {
    if (!signal.aborted) set({ run: null, problem: shownProblem(error) });
  }
}

const waiting = (status, settings) => ({ job: { id: null, status, progress: 0, stage: null }, done: [], settings, cancels: true });

/** Asks what is on the screen. The job before, if it has not ended, is canceled. */
export async function ask() {
  const { picture, question, settings, result } = get();
  if (!picture || !question.trim()) return;
  if (result && result.asked.question !== question) forgetMotion(question);
  const { corrections } = get();
  const { signal } = begin();
  const asked = { question, settings, corrections };
  set({ run: waiting("sending", settings), problem: null, compared: [] });
  await guarded(signal, async () => {
    const job = await submit(picture, settings.kind, requestOf(asked), signal);
    forgetLook(); // the picture is kept for this job now
    history.pushState(null, "", jobAddress(job.id));
    await watch(job, asked, signal, true);
  });
}

/** Another question says itself what moves and how: what was corrected of that belongs to the one before. */
function forgetMotion(question) {
  const { corrections, past } = get();
  const { grounding } = corrections;
  const isOther = grounding?.object && !question.toLowerCase().includes(grounding.object.toLowerCase());
  if (!corrections.motion && !corrections.trajectory && !isOther) return;
  const kept = { ...corrections, motion: null, trajectory: null, grounding: isOther ? null : grounding };
  set({ corrections: kept, past: [...past, corrections].slice(-MOST_UNDONE), future: [] });
}

/** Ends the job that the page waits for; what is shown is the result before, and what was asked for it. */
export function cancel() {
  const { run, result } = get();
  if (run?.job.id) void cancelJob(run.job.id);
  set({ run: null, ...(result ? { corrections: result.asked.corrections } : {}) });
  begin();
}

/** Changes corrections and asks again, if something was asked before. */
export function correct(change) {
  const { corrections, past } = get();
  set({ corrections: { ...corrections, ...change }, past: [...past, corrections].slice(-MOST_UNDONE), future: [], tool: "select" });
  askAgain();
}

function askAgain() {
  const { result, problem, run } = get();
  if (result || problem || run) void ask();
}

function step(from, to) {
  const state = get();
  if (!state[from].length) return;
  set({ corrections: state[from].at(-1), [from]: state[from].slice(0, -1), [to]: [...state[to], state.corrections] });
  askAgain();
}

export const undo = () => step("past", "future");
export const redo = () => step("future", "past");

/** Changes settings. Options belong to one generator; answers that are written anew replace those of an opened job. */
export function changeSettings(change) {
  const { settings } = get();
  const { options, ...rest } = settings.rest;
  const also = "choices" in change ? { rest } : "generator" in change ? { generator_options: {} } : {};
  set({ settings: { ...settings, ...change, ...also } });
}

function showPicture(picture, more) {
  const { picture: before } = get();
  if (before?.blob && before.url !== picture?.url) URL.revokeObjectURL(before.url);
  set({ picture, found: [], view: "case", ...NOTHING_ASKED, ...more });
}

/** Back to the start. */
export function restart() {
  begin();
  forgetLook();
  showPicture(null, { question: "", corrections: NOTHING_CORRECTED });
}

/** Forgets the key, and what it was good for. */
export function leave() {
  forgetKey();
  forgetArtifacts();
  restart();
}

/** The size of a picture at an address. Throws where the browser cannot show it. */
async function sizeOf(url) {
  const image = new Image();
  image.src = url;
  await image.decode();
  return { width: image.naturalWidth, height: image.naturalHeight };
}

let chosen = 0; // pictures so far: the latest counts

/** Shows a picture that was dropped, pasted, chosen or photographed, and looks what is in it; or asks its question, where `asks`. */
export async function choosePicture(blob, name, question = "", asks = false) {
  const number = (chosen += 1);
  let url = URL.createObjectURL(blob);
  let sent = null;
  try {
    sent = await sendable(blob, await sizeOf(url));
    if (sent.blob !== blob) {
      URL.revokeObjectURL(url);
      url = URL.createObjectURL(sent.blob);
    }
  } catch {
    const detail = `“${name}” is no picture that the browser can show. Take a PNG, JPEG or WebP.`;
    if (number === chosen) set({ problem: { code: "not-a-picture", title: "That is not a picture.", detail, errors: [] } });
  }
  if (sent === null || number !== chosen) return URL.revokeObjectURL(url);
  begin();
  forgetLook();
  const picture = { url, sha256: null, ...sent, name };
  showPicture(picture, { question, corrections: NOTHING_CORRECTED });
  history.pushState(null, "", pageAddress());
  return asks ? ask() : look(picture);
}

let looked = null; // the job of `look`: its id, and what ends the wait for it

/** Looks what is in a picture, for suggestions. Its job is removed once another one keeps the picture. */
async function look(picture) {
  // A mover of some pixels that stands still: what is found is all the rest.
  const request = {
    question: "What is in the picture?",
    grounding: { object: "corner", bbox: [0, 0, 3, 3] },
    motion: { kind: "static" },
    num_frames: 2, video: false, ensemble: 0, frames: { count: 1 }, generator: "cutout",
  };
  const isShown = () => get().picture?.url === picture.url;
  const waits = new AbortController();
  try {
    const job = await submit(picture, "simulate", request, undefined);
    looked = { id: job.id, waits };
    const { run, result } = get();
    if (!isShown() || run?.job.id || result) return forgetLook();
    const { simulation, problem } = outcomeOf(await ended(job.id, () => {}, waits.signal));
    if (!isShown() || waits.signal.aborted) return undefined; // it was removed meanwhile
    if (simulation) set({ found: simulation.trajectory.bodies.slice(1), picture: { ...get().picture, sha256: simulation.image.sha256 } });
    else if (problem?.code.startsWith("image-")) set({ problem });
  } catch (error) {
    if (waits.signal.aborted) return undefined; // it was removed meanwhile
    if (isShown() && (error.code?.startsWith("image-") || error.code === "body-too-large")) set({ problem: error });
    // Otherwise there are no suggestions: the error is shown with the next request.
  }
  return undefined;
}

/** Removes the job of `look`, also where the page is closed meanwhile. */
export function forgetLook() {
  if (looked === null) return;
  const { id, waits } = looked;
  looked = null;
  waits.abort(); // first: following a deleted job would raise an error
  call(`/jobs/${id}`, { method: "DELETE", keepalive: true }).catch(() => {});
}

/** Shows a job as if it had been asked here. */
export async function openJob(id) {
  const { signal } = begin();
  set({ view: "case", run: { ...waiting("opening", get().settings), cancels: false }, problem: null, compared: [] });
  await guarded(signal, async () => {
    if (!JOB_ID.test(id)) throw new Problem({ type: "urn:cow:problem:job-not-found", title: "There is no such job.", detail: "The link names none." }, 404);
    const read = () => Promise.all([callJson(`/jobs/${id}`, { signal }), callJson(`/jobs/${id}/request`, { signal })]);
    const [job, accepted] = await persist(read, tellAway, signal);
    const asked = stateOf(accepted.kind, accepted.request);
    const sha256 = accepted.request.image.artifact;
    const url = await artifactAddress(sha256);
    const size = await sizeOf(url).catch(() => ({ width: 640, height: 480 })); // it is gone: what was found is still shown
    if (signal.aborted) return;
    const { answer, simulation, problem } = outcomeOf(job);
    const result = job.status === "succeeded" ? { jobId: id, kind: job.kind, answer, simulation, settings: asked.settings, asked } : null;
    showPicture({ url, blob: null, sha256, ...size, name: "image" }, { ...asked, result, problem });
    if (job.status === "queued" || job.status === "running") await watch(job, asked, signal, false);
  });
}

/** Asks what the result on the screen was asked of another reader or generator, beside it. */
export async function compareWith(change) {
  const { picture, result } = get();
  const label = Object.values(change).join(", ");
  const options = "generator" in change ? { generator_options: {} } : {};
  const settings = { ...result.asked.settings, ...change, ...options };
  const put = (entry) => set(({ compared, result: shown }) =>
    shown === result ? { compared: [...compared.filter((each) => each.label !== label), { label, ...entry }] } : {});
  put({ status: "running" });
  try {
    const job = await submit(picture, settings.kind, requestOf({ ...result.asked, settings }), undefined);
    const { answer, simulation, problem } = outcomeOf(await ended(job.id, () => {}, undefined));
    put({ status: answer || simulation ? "succeeded" : "failed", jobId: job.id, answer, simulation, problem });
  } catch (error) {
    put({ status: "failed", problem: shownProblem(error) });
  }
}

/** Puts the result before beside the one that is shown. */
export function compareWithBefore() {
  const { before: { jobId, answer, simulation }, compared } = get();
  const label = "The what-if before";
  set({ compared: [...compared.filter((each) => each.label !== label), { label, status: "succeeded", jobId, answer, simulation }] });
}

/** Reads what the server has; questions do not wait for it. */
export async function loadModels() {
  try {
    set({ models: await persist(() => callJson("/models"), tellAway) });
  } catch (error) {
    set({ problem: shownProblem(error) });
  }
}
