// The question, suggestions, and how it is to be answered.

import { html, useEffect, useRef } from "../vendor/htm-preact.js";
import { ask, cancel, changeSettings, correct } from "../app/asking.js";
import { correctedWords } from "../app/corrections.js";
import { NOTHING_CORRECTED, set } from "../app/store.js";
import { suggestionsOf } from "../app/suggestions.js";

const MOST_CHARACTERS = 4000;

function send(event) {
  event.preventDefault();
  void ask();
}

export function Question({ state }) {
  const { question, run, found, result, picture, settings, models } = state;
  const field = useRef(null);
  useEffect(() => {
    if (field.current && !matchMedia("(pointer: coarse)").matches) field.current.focus({ preventScroll: true });
  }, [picture?.url]);
  useEffect(() => {
    const { current } = field;
    current.style.height = "auto";
    current.style.height = `${Math.min(current.scrollHeight + 2, 260)}px`;
  }, [question]);
  const corrected = correctedWords(state.corrections);
  const suggestions = result || question ? [] : suggestionsOf(found);
  return html`<form class="question" onSubmit=${send}>
    <label for="question">What if…</label>
    <textarea id="question" ref=${field} dir="auto" rows="2" maxlength=${MOST_CHARACTERS} value=${question} placeholder="If the toy car moves forward, will it hit the vase?"
      onInput=${(event) => set({ question: event.target.value })}
      onKeyDown=${(event) => event.key === "Enter" && !event.shiftKey && !event.isComposing && send(event)}></textarea>
    ${suggestions.length > 0 && html`<ul class="suggestions" aria-label="Suggestions">
      ${suggestions.map((text) => html`<li key=${text}><button type="button" dir="auto" onClick=${() => {
        set({ question: text });
        void ask();
      }}>${text}</button></li>`)}
    </ul>`}
    ${corrected && html`<p class="hint">Asked with your corrections: ${corrected}. <button type="button" class="plain" onClick=${() => correct(NOTHING_CORRECTED)}>Forget them</button></p>`}
    <div class="row">
      <button class="primary" disabled=${!picture || !question.trim()}>${settings.kind === "answer" ? "Ask" : "Imagine"}</button>
      ${run && html`<button type="button" onClick=${cancel}>Cancel</button>`}
    </div>
    <${Settings} settings=${settings} models=${models} />
  </form>`;
}

function Choice({ label, value, options, onChange }) {
  return html`<label>${label}<select value=${value} onChange=${(event) => onChange(event.target.value)}>
    ${options.map(([name, text]) => html`<option key=${name} value=${name} selected=${name === value}>${text}</option>`)}
  </select></label>`;
}

function Whole({ label, value, min, max, onChange }) {
  const changed = (event) => event.target.checkValidity() && event.target.value !== "" && onChange(Number(event.target.value));
  return html`<label>${label}<input type="number" inputmode="numeric" value=${value} min=${min} max=${max} onChange=${changed} /></label>`;
}

const backends = (list) => [["", `as the server does (${list.find((each) => each.default)?.name ?? "…"})`],
  ...list.map(({ name, ready, missing }) => [name, ready === false || missing.length ? `${name} (not ready)` : name])];

function Settings({ settings, models }) {
  const answering = settings.kind === "answer";
  return html`<details class="settings">
    <summary>How to answer</summary>
    <div class="fields">
      <${Choice} label="What is wanted" value=${settings.kind} onChange=${(kind) => changeSettings({ kind })}
        options=${[["answer", "an answer, after looking"], ["simulate", "the frames alone"]]} />
      ${answering && html`<${Choice} label="Imagine" value=${settings.imagine} onChange=${(imagine) => changeSettings({ imagine })}
        options=${[["always", "always"], ["auto", "only where first answers disagree"], ["never", "never"]]} />`}
      ${models && html`<${Choice} label="Reader" value=${settings.reader} options=${backends(models.readers)} onChange=${(reader) => changeSettings({ reader })} />`}
      ${models && html`<${Choice} label="Generator" value=${settings.generator} options=${backends(models.generators)} onChange=${(generator) => changeSettings({ generator })} />`}
      <${Choice} label="Frames" value=${settings.frames.policy ?? "events"} onChange=${(policy) => changeSettings({ frames: { ...settings.frames, policy } })}
        options=${[["events", "where something happens"], ["initial", "the first ones"], ["uniform", "all over the clip"]]} />
      <${Whole} label="How many frames" value=${settings.frames.count ?? 4} min="1" max="64" onChange=${(count) => changeSettings({ frames: { ...settings.frames, count } })} />
      ${answering && html`<${Whole} label="Votes" value=${settings.votes} min="1" max="32" onChange=${(votes) => changeSettings({ votes })} />`}
      <${Whole} label="Length of the clip, frames" value=${settings.num_frames} min="2" max="481" onChange=${(num_frames) => changeSettings({ num_frames })} />
      <${Whole} label="Worlds" value=${settings.ensemble} min="0" max="500" onChange=${(ensemble) => changeSettings({ ensemble })} />
      <${Whole} label="Seed" value=${settings.seed ?? ""} min="0" max=${2 ** 32 - 1} onChange=${(seed) => changeSettings({ seed })} />
    </div>
    ${answering && html`<label class="check"><input type="checkbox" checked=${settings.baseline} onChange=${(event) => changeSettings({ baseline: event.target.checked })} />
      Also answer without imagination, to compare</label>
    <label class="wide">Answers to choose from, one on each line<textarea rows="3" dir="auto" value=${settings.choices}
      placeholder="Those in the question" onChange=${(event) => changeSettings({ choices: event.target.value })}></textarea></label>`}
  </details>`;
}
