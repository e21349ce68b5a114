// The stages of a request: which are done, which one runs, which were cached.

import { html } from "../vendor/htm-preact.js";
import { STAGES, percent, plural, seconds, stagesOf } from "../app/words.js";

function running(run) {
  const order = Object.keys(STAGES);
  const at = order.indexOf(run.job.stage);
  const done = Math.max(-1, ...run.done.map((stage) => order.indexOf(stage)));
  const shown = [...stagesOf(run.settings), run.job.stage];
  return order.filter((stage) => shown.includes(stage)).map((stage) => {
    const place = order.indexOf(stage);
    return { stage, state: place <= done || place < at ? "done" : place === at ? "now" : "next", text: "" };
  });
}

function ended(result) {
  const made = result.answer ?? result.simulation;
  const timings = { ...(result.simulation?.timings ?? {}), ...made.timings };
  const reused = new Set([...(result.simulation?.reused ?? []), ...made.reused]);
  return Object.keys(STAGES).filter((stage) => stage in timings || reused.has(stage)).map((stage) => ({
    stage,
    state: reused.has(stage) ? "kept" : "done",
    text: reused.has(stage) ? "kept" : seconds(timings[stage]),
  }));
}

function waiting({ status, position, expected_wait: wait, progress }) {
  if (status === "sending") return "Sending the picture…";
  if (status === "opening") return "Opening the job…";
  if (status === "queued") {
    const ahead = position ? `${plural(position, "job is", "jobs are")} before it` : "It is the next";
    return `In the queue: ${ahead}${wait ? `, about ${seconds(wait)}` : ""}.`;
  }
  return `Running: ${percent(progress)}`;
}

/** Of a job in the making, or of a result. */
export function Stages({ run = null, result = null }) {
  const stages = run ? running(run) : ended(result);
  return html`<section class="stages" aria-label="Stages">
    <ol>${stages.map(({ stage, state, text }) => html`<li key=${stage} class=${state} data-stage=${stage} data-state=${state}><span class="dot" aria-hidden="true"></span>${STAGES[stage]}
      <small>${text || { now: "now", next: "", done: "done" }[state]}</small></li>`)}</ol>
    ${run && html`<p role="status" class="waiting-text">${waiting(run.job)}</p>
      <progress max="1" value=${run.job.status === "running" ? run.job.progress : undefined} aria-label="Progress"></progress>`}
  </section>`;
}
