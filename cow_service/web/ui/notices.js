// What went wrong and what to do, the server being away, and the dialog for an API key.

import { html, useEffect, useRef } from "../vendor/htm-preact.js";
import { ask } from "../app/asking.js";
import { get, set } from "../app/store.js";
import { remedyOf } from "../app/words.js";

const TOOLS = { "cannot-ground": ["mover", "Draw its box"], "object-not-found": ["mover", "Draw its box"], "cannot-read-direction": ["direction", "Draw the direction"] };
const AGAIN = new Set(["queue-full", "rate-limited", "storage-unavailable", "not-ready", "worker-ended", "job-timeout", "mllm-unavailable",
  "reader-unavailable", "perception-unavailable", "generator-unavailable", "generator-out-of-memory", "device-failed", "weights-unavailable", "internal-error", "mllm-bad-reply", "mllm-refused", "unauthorized"]);

export function ProblemNotice({ problem }) {
  const tool = get().picture ? TOOLS[problem.code] : undefined;
  const again = AGAIN.has(problem.code) && get().picture && get().question;
  return html`<div class="notice problem" role="alert">
    <h2>${problem.title}</h2>
    <p dir="auto">${problem.detail}</p>
    ${(problem.errors ?? []).length > 1 && html`<ul>${problem.errors.map((each) => html`<li key=${each.pointer} dir="auto"><code>${each.pointer}</code> ${each.detail}</li>`)}</ul>`}
    ${remedyOf(problem) && html`<p>${remedyOf(problem)}</p>`}
    ${problem.retryAfter && html`<p>The server asks to wait ${problem.retryAfter} s.</p>`}
    <div class="row">
      ${tool && html`<button class="primary" onClick=${() => set({ tool: tool[0] })}>${tool[1]}</button>`}
      ${again && html`<button onClick=${() => ask()}>Try again</button>`}
      <button onClick=${() => set({ problem: null })}>Close</button>
    </div>
  </div>`;
}

export function AwayNotice() {
  return html`<div class="notice away" role="alert"><p>The server does not answer. The page tries again by itself; your picture and your corrections are kept.</p></div>`;
}

/** Asks for an API key. It is kept until the tab is closed. */
export function KeyDialog({ wanted }) {
  const dialog = useRef(null);
  const field = useRef(null);
  useEffect(() => {
    dialog.current.showModal();
    field.current.focus();
  }, []);
  const answer = (key) => {
    set({ keyWanted: null });
    wanted.answer(key);
  };
  const submit = (event) => {
    event.preventDefault();
    const key = field.current.value.trim();
    if (key) answer(key);
  };
  return html`<dialog ref=${dialog} aria-labelledby="key-title" onCancel=${(event) => {
    event.preventDefault();
    answer(null);
  }}>
    <form onSubmit=${submit}>
      <h2 id="key-title">This server needs an API key</h2>
      ${wanted.reason && html`<p class="warning" role="alert">${wanted.reason}</p>`}
      <p>Ask the operator of this server for a key. It is kept only in this tab, and forgotten when the tab is closed.</p>
      <label>API key<input ref=${field} type="password" autocomplete="off" required maxlength="500" /></label>
      <div class="row"><button class="primary">Use it</button><button type="button" onClick=${() => answer(null)}>Cancel</button></div>
    </form>
  </dialog>`;
}
