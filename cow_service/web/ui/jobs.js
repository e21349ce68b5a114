// The caller's jobs: what each is, how far it is, and what went wrong.

import { html, useEffect, useState } from "../vendor/htm-preact.js";
import { openJob, shownProblem, tellAway } from "../app/asking.js";
import { jobAddress } from "../app/address.js";
import { call, callJson, codeOf, persist } from "../app/server.js";
import { set } from "../app/store.js";
import { CORRECTED, percent, remedyOf, when } from "../app/words.js";
import { Shot } from "./filmstrip.js";

const STATUSES = ["", "queued", "running", "succeeded", "failed", "canceled"];
const LIMIT = 30;
const SURE_SECONDS = 4; // in which a second press deletes
const REFRESH_SECONDS = 2; // while a job is in the making

const isOpen = (job) => job.status === "queued" || job.status === "running";

async function read(filters, cursor, signal) {
  const query = new URLSearchParams({ limit: LIMIT });
  for (const [name, value] of Object.entries(filters)) if (value) query.set(name, value);
  if (cursor) query.set("cursor", cursor);
  return persist(() => callJson(`/jobs?${query}`, { signal }), tellAway, signal);
}

export function Jobs() {
  const [filters, setFilters] = useState({ status: "", kind: "" });
  const [cursors, setCursors] = useState([null]); // of the pages up to this one
  const [page, setPage] = useState(null);
  const [refreshed, setRefreshed] = useState(0);
  const refresh = () => setRefreshed((times) => times + 1);
  const choose = (change) => {
    setFilters({ ...filters, ...change });
    setCursors([null]);
  };

  useEffect(() => {
    const controller = new AbortController();
    const { signal } = controller;
    read(filters, cursors.at(-1), signal).then((found) => !signal.aborted && setPage(found), (error) => !signal.aborted && set({ problem: shownProblem(error) }));
    return () => controller.abort();
  }, [filters, cursors, refreshed]);
  useEffect(() => {
    if (!page?.jobs.some(isOpen)) return undefined;
    const timer = setTimeout(refresh, 1000 * REFRESH_SECONDS);
    return () => clearTimeout(timer);
  }, [page]);

  const act = async (path, method) => {
    try {
      await call(path, { method });
    } catch (error) {
      set({ problem: shownProblem(error) });
    }
    refresh();
  };
  return html`<section class="jobs" aria-label="Jobs">
    <div class="row">
      <h1>Jobs</h1>
      <label>Status<select onChange=${(event) => choose({ status: event.target.value })}>
        ${STATUSES.map((status) => html`<option key=${status} value=${status}>${status || "all"}</option>`)}</select></label>
      <label>Kind<select onChange=${(event) => choose({ kind: event.target.value })}>
        <option value="">all</option><option value="answer">answer</option><option value="simulate">simulate</option></select></label>
      <button onClick=${refresh}>Refresh</button>
    </div>
    ${page === null && html`<p role="status">Reading the jobs…</p>`}
    ${page?.jobs.length === 0 && html`<p class="hint">${filters.status || filters.kind ? "No job matches." : "There are no jobs yet. Ask a question, and it is listed here."}</p>`}
    <ul class="joblist">${page?.jobs.map((job) => html`<${JobRow} key=${job.id} job=${job} act=${act} />`)}</ul>
    <div class="row">
      ${cursors.length > 1 && html`<button onClick=${() => setCursors(cursors.slice(0, -1))}>Newer</button>`}
      ${page?.next && html`<button onClick=${() => setCursors([...cursors, page.next])}>Older</button>`}
    </div>
  </section>`;
}

/** Deletes at the second press. */
function Delete({ name, onDelete }) {
  const [asked, setAsked] = useState(false);
  useEffect(() => {
    const timer = asked && setTimeout(() => setAsked(false), 1000 * SURE_SECONDS);
    return () => clearTimeout(timer);
  }, [asked]);
  return html`<button onClick=${() => (asked ? onDelete() : setAsked(true))} aria-label=${`${asked ? "Really delete" : "Delete"}: ${name}`}>${asked ? "Really?" : "Delete"}</button>`;
}

function JobRow({ job, act }) {
  const open = (event) => {
    if (event.ctrlKey || event.metaKey || event.shiftKey) return;
    event.preventDefault();
    history.pushState(null, "", jobAddress(job.id));
    void openJob(job.id);
  };
  const problem = job.problem && { ...job.problem, code: codeOf(job.problem) };
  return html`<li class=${`job ${job.status}`}>
    <div class="thumb">${job.image && html`<${Shot} sha256=${job.image} alt="" loading="lazy" />`}</div>
    <div class="about">
      <a href=${jobAddress(job.id)} onClick=${open} dir="auto">${job.question ?? job.id}</a>
      ${job.answer && html`<p class="answered" dir="auto">${job.answer}</p>`}
      ${job.given.length > 0 && html`<p class="facts">Corrected: ${job.given.map((name) => CORRECTED[name] ?? name).join(", ")}</p>`}
      <p class="facts"><span class=${`badge ${job.status}`}>${job.status}</span> ${job.kind}, ${job.generator}, <time datetime=${job.created_at}>${when(job.created_at)}</time></p>
      ${job.status === "running" && html`<p class="facts">${job.stage ?? "starting"}, ${percent(job.progress)}</p><progress max="1" value=${job.progress} aria-label="Progress"></progress>`}
      ${problem && html`<p class="warning" dir="auto">${problem.detail} ${remedyOf(problem)}</p>`}
    </div>
    <div class="actions">
      ${isOpen(job) && html`<button onClick=${() => act(`/jobs/${job.id}/cancel`, "POST")}>Cancel</button>`}
      <${Delete} name=${job.question ?? job.id} onDelete=${() => act(`/jobs/${job.id}`, "DELETE")} />
    </div>
  </li>`;
}
