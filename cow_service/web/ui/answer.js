// The answer with and without imagination, what it depends on, and the same question asked of others.

import { html } from "../vendor/htm-preact.js";
import { compareWith } from "../app/asking.js";
import { jobAddress } from "../app/address.js";
import { DOUBTS, answerWords, percent, plural, seconds } from "../app/words.js";
import { Shot } from "./filmstrip.js";

const FIRST_WARNINGS = 2; // that are shown before somebody asks for the rest

function Votes({ votes }) {
  const all = Object.entries(votes);
  const total = all.reduce((sum, [, count]) => sum + count, 0);
  if (total < 2) return null;
  return html`<ul class="votes" aria-label="Votes">${all.map(([name, count]) => html`<li key=${name}><span dir="auto">${name}</span>
    <meter min="0" max=${total} value=${count} aria-label=${`${count} of ${total} votes`}></meter><small>${count} of ${total}</small></li>`)}</ul>`;
}

function Verdict({ title, verdict, kind }) {
  return html`<article class=${`verdict ${kind}`}>
    <h3>${title}</h3>
    <p class=${verdict.answer === null ? "said unsure" : "said"} dir="auto">${answerWords(verdict)}</p>
    <${Votes} votes=${verdict.votes} />
    ${verdict.reasoning && html`<p class="reasoning" dir="auto">${verdict.reasoning}</p>`}
  </article>`;
}

function Outcome({ trajectory, said = "" }) {
  const { outcome, ensemble } = trajectory;
  if (!outcome) return null;
  return html`<div class="outcome">
    ${outcome.probability !== null && ensemble > 0 && html`<p class="probability"><meter min="0" max="1" value=${outcome.probability} aria-hidden="true"></meter>
      <b>${percent(outcome.probability)}</b> of ${plural(ensemble, "world")}${outcome.time === null ? "" : `, after ${seconds(outcome.time)}`}${
        outcome.time_band ? ` (${outcome.time_band.map((time) => time.toFixed(1)).join(" to ")} s)` : ""}</p>`}
    ${outcome.depends_on.length > 0 && html`<p>It depends on ${outcome.depends_on.map((doubt) => DOUBTS[doubt] ?? doubt).join(", ")}.</p>`}
    ${outcome.facts && outcome.facts !== said && html`<p dir="auto">${outcome.facts}</p>`}
  </div>`;
}

function Cost({ made }) {
  const time = Object.values(made.timings).reduce((sum, value) => sum + value, 0);
  const { calls, input_tokens: sent, output_tokens: received } = made.usage;
  const tokens = calls ? `${plural(calls, "call")}, ${sent} + ${received} tokens` : "no tokens";
  return html`<p class="cost">${seconds(time)} of work, ${tokens}${made.reused.length ? `, ${plural(made.reused.length, "stage")} kept` : ""}</p>`;
}

function Gate({ gate }) {
  if (!gate) return null;
  const why = { agreed: "the first answers agreed", disagreed: "the first answers disagreed", "not-sure": "the first answers were not sure", unreadable: "no first answer could be read" };
  return html`<p class="gate">${gate.imagined ? "Imagined" : "Not imagined"}: ${why[gate.reason]} (${percent(gate.agreement)} of ${plural(gate.asked, "vote")}).</p>`;
}

function Warnings({ warnings }) {
  const item = (text) => html`<li key=${text} dir="auto">${text}</li>`;
  const rest = warnings.slice(FIRST_WARNINGS);
  return html`<div class="warnings"><ul>${warnings.slice(0, FIRST_WARNINGS).map(item)}</ul>
    ${rest.length > 0 && html`<details><summary>${plural(rest.length, "more note")}</summary><ul>${rest.map(item)}</ul></details>`}</div>`;
}

export function Result({ state }) {
  const { result, compared, models, run } = state;
  const { answer, simulation } = result;
  // Why nothing was imagined is told as a problem, with what can be done.
  const warnings = answer?.simulation_problem ? [] : (answer ?? simulation).warnings;
  return html`<section class=${run ? "result old" : "result"} aria-label="Result" aria-busy=${Boolean(run)} data-job=${result.jobId}>
    ${run && html`<p class="hint">Of the request before:</p>`}
    ${answer && html`<div class="verdicts">
      <${Verdict} title=${simulation ? "After looking" : "From the picture alone"} verdict=${answer} kind="looked" />
      ${answer.baseline && html`<${Verdict} title="Without imagination" verdict=${answer.baseline} kind="baseline" />`}
    </div>`}
    ${answer && html`<${Gate} gate=${answer.gate} />`}
    ${simulation && html`<p class="sentence" dir="auto">${simulation.motion.sentence}</p><${Outcome} trajectory=${simulation.trajectory} said=${answer?.reasoning} />`}
    ${simulation?.trajectory.placement && html`<p>${`It ends ${simulation.trajectory.placement.result.replaceAll("-", " ")}.`}</p>`}
    <${Cost} made=${answer ?? simulation} />
    <${Warnings} warnings=${warnings} />
    ${models && html`<${Others} models=${models} settings=${result.settings} busy=${Boolean(run)} compared=${compared} />`}
  </section>`;
}

const usable = (list, current) => list.filter((each) => each.ready !== false && !each.missing.length
  && each.name !== (current || list.find((one) => one.default)?.name));

function Others({ models, settings, busy, compared }) {
  const readers = usable(models.readers, settings.reader);
  const generators = usable(models.generators, settings.generator);
  if (!readers.length && !generators.length && !compared.length) return null;
  return html`<div class="others">
    <h3>Side by side</h3>
    <div class="row">
      ${readers.map(({ name }) => html`<button key=${`reader ${name}`} disabled=${busy} onClick=${() => compareWith({ reader: name })}>Reader ${name}</button>`)}
      ${generators.map(({ name }) => html`<button key=${`generator ${name}`} disabled=${busy} onClick=${() => compareWith({ generator: name })}>Generator ${name}</button>`)}
    </div>
    <div class="columns">${compared.map((other) => html`<${Other} key=${other.label} other=${other} />`)}</div>
  </div>`;
}

function Other({ other }) {
  const { label, status, answer, simulation, problem, jobId } = other;
  return html`<article class="verdict">
    <h3>${label}</h3>
    ${status === "running" && html`<p role="status">Running…</p><progress aria-label=${`Progress of ${label}`}></progress>`}
    ${answer && html`<p class="said" dir="auto">${answerWords(answer)}</p>${answer.reasoning && html`<p class="reasoning" dir="auto">${answer.reasoning}</p>`}`}
    ${simulation && html`<${Outcome} trajectory=${simulation.trajectory} said=${answer?.reasoning} /><div class="filmstrip">${simulation.frames.map((frame) =>
      html`<span class="shot" key=${frame.index}><${Shot} sha256=${frame.sha256} alt=${`Frame ${frame.index}`} /></span>`)}</div>`}
    ${(answer || simulation) && html`<${Cost} made=${answer ?? simulation} />`}
    ${problem && html`<p class="warning">${problem.detail}</p>`}
    ${jobId && html`<a href=${jobAddress(jobId)} target="_blank" rel="noopener">Open its job</a>`}
  </article>`;
}
