// The answer, with and without imagination, what it depends on, and the same question asked of others.

import { html } from "../vendor/htm-preact.js";
import { compareWith, compareWithBefore } from "../app/asking.js";
import { jobAddress } from "../app/address.js";
import { DOUBTS, answerWords, percent, plural, seconds } from "../app/words.js";
import { Shot } from "./filmstrip.js";
import { Stages } from "./stages.js";
import { Share } from "./take.js";

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

/** How many simulated versions agree with the simulation's summary, as a bar. */
function Versions({ simulation: { narration, trajectory } }) {
  if (!trajectory.outcome || narration.share === null) return null;
  const label = narration.agreement || narration.summary;
  return html`<p class="probability"><meter min="0" max="1" value=${narration.share} aria-label=${label} title=${label}></meter></p>`;
}

/** What the simulation's answer depends on, most important first. */
function Depends({ outcome }) {
  const doubts = outcome?.depends_on ?? [];
  if (!doubts.length) return null;
  return html`<p class="depends">It depends on ${doubts.map((doubt) => DOUBTS[doubt] ?? doubt).join(", ")}.</p>`;
}

const Story = ({ simulation }) => simulation.narration.story && html`<p class="story" dir="auto">${simulation.narration.story}</p>`;

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

/** Whether the answer from the picture alone says something: a multimodal LLM gave it, and another one than after looking. */
const differs = ({ answer, baseline, usage_total: usage }) => baseline && usage.calls > 0 && baseline.answer !== answer;

/** The answer first: what it is, in a sentence, and how many worlds say so. How it came about is a click away. */
export function Result({ state }) {
  const { result, compared, models, run } = state;
  const { answer, simulation } = result;
  const outcome = simulation?.trajectory.outcome;
  // Why nothing was imagined is told as a problem, with what can be done.
  const warnings = answer?.simulation_problem ? [] : (answer ?? simulation).warnings;
  const baseline = answer?.baseline && html`<${Verdict} title="Without imagination" verdict=${answer.baseline} kind="baseline" />`;
  const isCompared = answer && differs(answer);
  return html`<section class=${`result ${run ? "old" : ""} ${state.isForeseeing && !run ? "faded" : ""}`} aria-label="Result" aria-busy=${Boolean(run)} data-job=${result.jobId}>
    ${run && html`<p class="hint">Of the request before:</p>`}
    ${answer && html`<${Verdict} title=${simulation ? "After looking" : "From the picture alone"} verdict=${answer} kind="looked" />`}
    ${simulation && !answer && html`<p class="reasoning" dir="auto">${simulation.narration.summary || simulation.motion.sentence}</p>`}
    ${answer && simulation && answer.reasoning !== simulation.narration.summary && simulation.narration.summary && html`<p class="reasoning" dir="auto">The simulation: ${simulation.narration.summary}</p>`}
    ${simulation && html`<${Versions} simulation=${simulation} /><${Depends} outcome=${outcome} />`}
    ${simulation?.trajectory.placement && html`<p>${`It ends ${simulation.trajectory.placement.result.replaceAll("-", " ")}.`}</p>`}
    ${isCompared && baseline}
    <${Warnings} warnings=${warnings} />
    ${simulation && !run && html`<${Share} jobId=${result.jobId} simulation=${simulation} />`}
    <details class="more"><summary>How it came about</summary>
      ${simulation && html`<p class="sentence" dir="auto">${simulation.motion.sentence}</p><${Story} simulation=${simulation} />`}
      ${!isCompared && baseline}
      ${answer && html`<${Gate} gate=${answer.gate} />`}
      ${!run && html`<${Stages} result=${result} />`}
      <${Cost} made=${answer ?? simulation} />
    </details>
    ${models && html`<${Others} models=${models} before=${state.before} settings=${result.settings} busy=${Boolean(run)} compared=${compared} />`}
  </section>`;
}

const usable = (list, current) => list.filter((each) => each.ready !== false && !each.missing.length
  && each.name !== (current || list.find((one) => one.default)?.name));

function Others({ models, before, settings, busy, compared }) {
  const readers = usable(models.readers, settings.reader);
  const generators = usable(models.generators, settings.generator);
  if (!readers.length && !generators.length && !compared.length && !before) return null;
  return html`<details class="others" open=${compared.length > 0}><summary>Side by side</summary>
    <div class="row">
      ${before && html`<button disabled=${busy} onClick=${compareWithBefore}>The what-if before</button>`}
      ${readers.map(({ name }) => html`<button key=${`reader ${name}`} disabled=${busy} onClick=${() => compareWith({ reader: name })}>Reader ${name}</button>`)}
      ${generators.map(({ name }) => html`<button key=${`generator ${name}`} disabled=${busy} onClick=${() => compareWith({ generator: name })}>Generator ${name}</button>`)}
    </div>
    <div class="columns">${compared.map((other) => html`<${Other} key=${other.label} other=${other} />`)}</div>
  </details>`;
}

function Other({ other }) {
  const { label, status, answer, simulation, problem, jobId } = other;
  return html`<article class="verdict">
    <h3>${label}</h3>
    ${status === "running" && html`<p role="status">Running…</p><progress aria-label=${`Progress of ${label}`}></progress>`}
    ${answer && html`<p class="said" dir="auto">${answerWords(answer)}</p>${answer.reasoning && html`<p class="reasoning" dir="auto">${answer.reasoning}</p>`}`}
    ${simulation && html`<${Versions} simulation=${simulation} /><${Depends} outcome=${simulation.trajectory.outcome} /><div class="filmstrip">${simulation.frames.map((frame) =>
      html`<span class="shot" key=${frame.index}><${Shot} sha256=${frame.sha256} alt=${`Frame ${frame.index}`} /></span>`)}</div>`}
    ${(answer || simulation) && html`<${Cost} made=${answer ?? simulation} />`}
    ${problem && html`<p class="warning">${problem.detail}</p>`}
    ${jobId && html`<a href=${jobAddress(jobId)} target="_blank" rel="noopener">Open its job</a>`}
  </article>`;
}
