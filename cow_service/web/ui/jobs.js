// The caller's jobs: what each is, how far it is, and what went wrong.

import { html, useEffect, useState } from "../vendor/htm-preact.js";
import { openJob, shownProblem, tellAway } from "../app/asking.js";
import { jobAddress } from "../app/address.js";
import { call, callJson, persist } from "../app/server.js";
import { set } from "../app/store.js";
import { percent, remedyOf, when } from "../app/words.js";
import { Shot } from "./filmstrip.js";

const STATUSES = ["", "queued", "running", "succeeded", "failed", "canceled"];
const LIMIT = 30;
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
  const [page, setPage] = useState(null);
  const [refreshed, refresh] = useState(0);

  useEffect(() => {
    const controller = new AbortController();
    const { signal } = controller;
    read(filters, null, signal).then((found) => !signal.aborted && setPage(found), (error) => !signal.aborted && set({ problem: shownProblem(error) }));
    return () => controller.abort();
  }, [filters, refreshed]);
  useEffect(() => {
    if (!page?.jobs.some(isOpen)) return undefined;
    const timer = setTimeout(() => refresh(refreshed + 1), 1000 * REFRESH_SECONDS);
    return () => clearTimeout(timer);
  }, [page]);

  const act = async (path, method) => {
    try {
      await call(path, { method });
    } catch (error) {
      set({ problem: shownProblem(error) });
    }
    refresh(refreshed + 1);
  };
  const more = async () => {
    const next = await read(filters, page.next);
    setPage({ jobs: [...page.jobs, ...next.jobs], next: next.next });
  };
  return html`<section class="jobs" aria-label="Jobs">
    <div class="row">
      <h1>Jobs</h1>
      <label>Status<select onChange=${(event) => setFilters({ ...filters, status: event.target.value })}>
        ${STATUSES.map((status) => html`<option key=${status} value=${status}>${status || "all"}</option>`)}</select></label>
      <label>Kind<select onChange=${(event) => setFilters({ ...filters, kind: event.target.value })}>
        <option value="">all</option><option value="answer">answer</option><option value="simulate">simulate</option></select></label>
      <button onClick=${() => refresh(refreshed + 1)}>Refresh</button>
    </div>
    ${page === null && html`<p role="status">Reading the jobs…</p>`}
    ${page?.jobs.length === 0 && html`<p class="hint">${filters.status || filters.kind ? "No job is like that." : "There are no jobs yet. Ask something, and it is listed here."}</p>`}
    <ul class="joblist">${page?.jobs.map((job) => html`<${JobRow} key=${job.id} job=${job} act=${act} />`)}</ul>
    ${page?.next && html`<button onClick=${more}>More</button>`}
  </section>`;
}

function JobRow({ job, act }) {
  const open = (event) => {
    if (event.ctrlKey || event.metaKey || event.shiftKey) return;
    event.preventDefault();
    history.pushState(null, "", jobAddress(job.id));
    void openJob(job.id);
  };
  const problem = job.problem && { ...job.problem, code: job.problem.type.split(":").pop() };
  return html`<li class=${`job ${job.status}`}>
    <div class="thumb">${job.image && html`<${Shot} sha256=${job.image} alt="" loading="lazy" />`}</div>
    <div class="about">
      <a href=${jobAddress(job.id)} onClick=${open} dir="auto">${job.question ?? job.id}</a>
      <p class="facts"><span class=${`badge ${job.status}`}>${job.status}</span> ${job.kind}, ${job.generator}, <time datetime=${job.created_at}>${when(job.created_at)}</time></p>
      ${job.status === "running" && html`<p class="facts">${job.stage ?? "starting"}, ${percent(job.progress)}</p><progress max="1" value=${job.progress} aria-label="Progress"></progress>`}
      ${problem && html`<p class="warning" dir="auto">${problem.detail} ${remedyOf(problem)}</p>`}
    </div>
    <div class="actions">
      ${isOpen(job) && html`<button onClick=${() => act(`/jobs/${job.id}/cancel`, "POST")}>Cancel</button>`}
      <button onClick=${() => act(`/jobs/${job.id}`, "DELETE")} aria-label=${`Delete: ${job.question ?? job.id}`}>Delete</button>
    </div>
  </li>`;
}
