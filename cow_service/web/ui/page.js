// The whole page.

import { html } from "../vendor/htm-preact.js";
import { address, jobAddress, jobsAddress, pageAddress } from "../app/address.js";
import { leave, restart } from "../app/asking.js";
import { currentKey } from "../app/keys.js";
import { set, useStore } from "../app/store.js";
import { answerWords } from "../app/words.js";
import { Correct } from "./correct.js";
import { Jobs } from "./jobs.js";
import { AwayNotice, KeyDialog, ProblemNotice } from "./notices.js";
import { Question } from "./question.js";
import { Result } from "./answer.js";
import { Scene } from "./scene.js";
import { Stages } from "./stages.js";
import { Choose, Start } from "./start.js";
import { Take } from "./take.js";

/** Does something and shows its address, unless a new tab is wanted. */
function go(event, href, work) {
  if (event.ctrlKey || event.metaKey || event.shiftKey) return;
  event.preventDefault();
  history.pushState(null, "", href);
  work();
}

function Header({ state }) {
  const { view, result } = state;
  const caseAddress = result ? jobAddress(result.jobId) : pageAddress();
  return html`<header>
    <a class="brand" href=${pageAddress()} onClick=${(event) => go(event, pageAddress(), restart)}><b>COW</b> <span>Causal Object World model</span></a>
    <nav aria-label="Page">
      <a href=${caseAddress} aria-current=${view === "case" ? "page" : undefined} onClick=${(event) => go(event, caseAddress, () => set({ view: "case", problem: null }))}>Try</a>
      <a href=${jobsAddress()} aria-current=${view === "jobs" ? "page" : undefined} onClick=${(event) => go(event, jobsAddress(), () => set({ view: "jobs", problem: null }))}>Jobs</a>
      <a href=${address("/docs")}>API</a>
      ${currentKey() !== null && html`<button class="plain" onClick=${leave}>Forget the key</button>`}
    </nav>
  </header>`;
}

function Case({ state }) {
  const { picture, run, result, problem } = state;
  if (!picture) return html`<${Start} />`;
  return html`<div class="case">
    <div class="left"><${Scene} state=${state} /></div>
    <div class="right">
      <${Question} state=${state} />
      ${problem && html`<${ProblemNotice} problem=${problem} />`}
      ${run && html`<${Stages} run=${run} />`}
      ${result && html`<${Result} state=${state} />`}
      <${Correct} state=${state} />
      ${state.question.trim() && html`<${Take} state=${state} />`}
      <${Choose} short />
    </div>
  </div>`;
}

/** What a screen reader says when something has ended. */
function heard({ result, run }) {
  if (run || !result) return "";
  return result.answer ? `Answer: ${answerWords(result.answer)}` : "The frames are ready.";
}

export function Page() {
  const state = useStore();
  const { view, away, keyWanted, problem, picture } = state;
  return html`<div class="page">
    <${Header} state=${state} />
    <main id="main" tabindex="-1">
      ${away && html`<${AwayNotice} />`}
      ${problem && (view === "jobs" || !picture) && html`<${ProblemNotice} problem=${problem} />`}
      ${view === "jobs" ? html`<${Jobs} />` : html`<${Case} state=${state} />`}
    </main>
    <p class="heard" role="status">${heard(state)}</p>
    ${keyWanted && html`<${KeyDialog} wanted=${keyWanted} />`}
  </div>`;
}

const TEXT = "textarea, input:not([type]), input[type=text], input[type=number], input[type=password]";

/** Whether keys belong to a text being written. */
export const isTyping = (target) => target instanceof Element && target.closest(TEXT) !== null;
