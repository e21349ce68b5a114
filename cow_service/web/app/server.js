// Calls of the HTTP API: problems, keys, and a server that is away.

import { address } from "./address.js";
import { askForKey, currentKey, forgetKey } from "./keys.js";

/** The code of a problem as the server tells it, such as `cannot-ground`; empty where it has none. */
export const codeOf = (problem) => String(problem.type ?? "").split(":").pop();

/** What the server answered instead of a result (RFC 9457). */
export class Problem extends Error {
  constructor(body, status, retryAfter = null) {
    super(body.detail || body.title || `The server answered ${status}.`);
    this.code = codeOf(body) || `http-${status}`;
    this.title = body.title || "The request failed.";
    this.detail = this.message;
    this.errors = body.errors || [];
    this.status = status;
    this.retryAfter = retryAfter;
  }
}

/** No answer: the network or the server is down. */
export class Unreachable extends Error {
  code = "unreachable";
  title = "The server does not answer.";
  detail = "The page tries again by itself. Your picture and your corrections are kept.";
}

const isAway = (error) => error instanceof Unreachable || error.code === "shutting-down";

async function problemOf(response) {
  let body = {};
  try {
    body = await response.json();
  } catch {
    // A proxy answered in words of its own.
  }
  const wait = Number(response.headers.get("Retry-After"));
  return new Problem(body ?? {}, response.status, wait > 0 ? wait : null);
}

/** A response that is not an error. Asks for a key where one is wanted. Throws `Problem` or `Unreachable`. */
export async function call(path, { method = "GET", body, headers = {}, signal, keepalive } = {}) {
  for (;;) {
    const key = currentKey();
    const sent = { ...headers, ...(key === null ? {} : { Authorization: `Bearer ${key}` }) };
    let response;
    try {
      response = await fetch(address(path), { method, body, headers: sent, signal, keepalive });
    } catch (error) {
      if (signal?.aborted) throw error;
      throw new Unreachable();
    }
    if (response.ok) return response;
    const problem = await problemOf(response);
    if (problem.code !== "unauthorized") throw problem;
    if (key !== currentKey()) continue; // another request was given a new one meanwhile
    if (key !== null) forgetKey();
    if (!(await askForKey(key === null ? "" : "The server does not know that key."))) throw problem;
  }
}

export const callJson = async (path, options) => (await call(path, options)).json();

export const postJson = (path, value, headers = {}, signal = undefined) =>
  callJson(path, { method: "POST", body: JSON.stringify(value), headers: { "Content-Type": "application/json", ...headers }, signal });

export const pause = (seconds, signal) =>
  new Promise((resolve, reject) => {
    const timer = setTimeout(resolve, 1000 * seconds);
    signal?.addEventListener("abort", () => {
      clearTimeout(timer);
      reject(signal.reason);
    });
  });

/** Tries again for as long as the server is away; `tell` hears whether it is. */
export async function persist(work, tell, signal) {
  for (let wait = 0.5; ; wait = Math.min(2 * wait, 5)) {
    try {
      const done = await work();
      tell(false);
      return done;
    } catch (error) {
      if (signal?.aborted || !isAway(error)) throw error;
      tell(true);
      await pause(wait, signal);
    }
  }
}

/** A key under which a request that is sent twice is one job. Also where the page was not served over TLS. */
export function newIdempotencyKey() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  return `page-${Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("")}`;
}
