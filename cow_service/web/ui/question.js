// The question, suggestions, and how it is to be answered.

import { html, useEffect, useRef, useState } from "../vendor/htm-preact.js";
import { ask, cancel, changeSettings, correct } from "../app/asking.js";
import { correctedWords } from "../app/corrections.js";
import { isSameBox } from "../app/geometry.js";
import { canSee, light, lookFor, takeAsMover } from "../app/seeing.js";
import { NOTHING_CORRECTED, set } from "../app/store.js";
import { CHANGES, OUTCOMES, sentenceOf, suggestionsOf, waysOf } from "../app/suggestions.js";

const MOST_CHARACTERS = 4000;
const TYPING_ENDS = 600; // ms without a key
// Where a question was not understood, others are shown that would be.
const NOT_UNDERSTOOD = ["cannot-ground", "object-not-found", "cannot-read-direction"];

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
  const stuck = NOT_UNDERSTOOD.includes(state.problem?.code);
  const suggestions = (result || question) && !stuck ? [] : suggestionsOf(found);
  return html`<form class="question" onSubmit=${send}>
    <label for="question">What if…</label>
    <textarea id="question" ref=${field} dir="auto" rows="2" maxlength=${MOST_CHARACTERS} value=${question} placeholder="If the toy car moves forward, will it hit the vase?"
      onInput=${(event) => set({ question: event.target.value })}
      onKeyDown=${(event) => event.key === "Enter" && !event.shiftKey && !event.isComposing && send(event)}></textarea>
    <${Chips} state=${state} />
    ${suggestions.length > 0 && html`<ul class="suggestions" aria-label=${stuck ? "Suggested questions" : "Suggestions"}>
      ${suggestions.map((text) => html`<li key=${text}><button type="button" dir="auto" onClick=${() => {
        set({ question: text });
        void ask();
      }}>${text}</button></li>`)}
    </ul>`}
    ${corrected && html`<p class="hint">Asked with your corrections: ${corrected}. <button type="button" class="plain" onClick=${() => correct(NOTHING_CORRECTED)}>Forget them</button></p>`}
    <div class="row">
      <button class="primary" disabled=${!picture || !question.trim()}>${settings.kind === "answer" ? "Ask" : "Imagine"}</button>
      ${run && html`<button type="button" onClick=${cancel}>Cancel</button>`}
      <${Builder} names=${[...new Set(found.map((body) => body.object).filter((name) => name && name !== "object"))]} />
      <${Settings} settings=${settings} models=${models} />
    </div>
  </form>`;
}

/** What the server's detector finds of what the question names. */
function Chips({ state }) {
  const { question, picture, named, corrections } = state;
  const asked = question.trim();
  const canFind = canSee(state, ["segmenter"]) && canSee(state, ["detector"]) && picture.blob !== null; // of an opened job all is known
  useEffect(() => {
    if (!canFind || !asked) return undefined;
    const timer = setTimeout(() => void lookFor(asked), TYPING_ENDS);
    return () => clearTimeout(timer);
  }, [asked, picture.url, canFind]);
  const things = (canFind && named.get(asked)) || [];
  return things.length > 0 && html`<ul class="chips" aria-label="Objects found: choose the moving one">
    <li class="hint">What moves?</li>
    ${things.map((thing, place) => html`<li key=${place}><button type="button" dir="auto" aria-pressed=${isSameBox(corrections.grounding?.bbox, thing.bbox)}
      title=${thing.light ? "Use it as the moving object" : "Use its box as the moving object: its outline is uncertain"} onClick=${() => takeAsMover(thing)}
      onFocus=${() => light(thing)} onBlur=${() => light(null)} onPointerEnter=${() => light(thing)} onPointerLeave=${() => light(null)}>${thing.name}</button></li>`)}
  </ul>`;
}

function Choice({ label, value, options, onChange }) {
  return html`<label>${label}<select value=${value} onChange=${(event) => onChange(event.target.value)}>
    ${options.map(([name, text]) => html`<option key=${name} value=${name} selected=${name === value}>${text}</option>`)}
  </select></label>`;
}

/** Makes a question of choices among the things that were found. */
function Builder({ names }) {
  const [parts, setParts] = useState({ change: "moves", outcome: "hit" });
  if (names.length < 2) return null;
  const among = (name, others) => (others.includes(parts[name]) ? parts[name] : others[0]);
  const thing = among("thing", names);
  const { ways, needsMover } = CHANGES[parts.change];
  const others = names.filter((name) => name !== thing);
  const mover = among("mover", others);
  const targets = needsMover && others.length > 1 ? others.filter((name) => name !== mover) : others;
  const target = among("target", targets);
  const way = among("way", waysOf(others.filter((name) => !needsMover || name !== mover)));
  const choice = (label, name, value, options) => html`<${Choice} label=${label} value=${value}
    options=${options.map((each) => [each, each])} onChange=${(chosen) => setParts({ ...parts, [name]: chosen })} />`;
  return html`<details class="builder">
    <summary>Build a question</summary>
    <div class="fields">
      ${choice("If the", "thing", thing, names)}
      ${choice("does what?", "change", parts.change, needsMover || others.length > 1 ? Object.keys(CHANGES) : Object.keys(CHANGES).filter((each) => !CHANGES[each].needsMover))}
      ${needsMover && choice("and then moves: the", "mover", mover, others)}
      ${ways && choice("which way?", "way", way, waysOf(others.filter((name) => !needsMover || name !== mover)))}
      ${choice("will it", "outcome", parts.outcome, Object.keys(OUTCOMES))}
      ${choice("the", "target", target, targets)}
    </div>
    <button type="button" onClick=${() => set({ question: sentenceOf({ ...parts, thing, mover, way, target }) })}>Take this question</button>
  </details>`;
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
      <${Whole} label="Worlds, at most" value=${settings.ensemble} min="0" max="500" onChange=${(ensemble) => changeSettings({ ensemble })} />
      <${Whole} label="Seed" value=${settings.seed ?? ""} min="0" max=${2 ** 32 - 1} onChange=${(seed) => changeSettings({ seed })} />
    </div>
    ${answering && html`<label class="check"><input type="checkbox" checked=${settings.baseline} onChange=${(event) => changeSettings({ baseline: event.target.checked })} />
      Also answer without imagination, to compare</label>
    <label class="wide">Answers to choose from, one on each line<textarea rows="3" dir="auto" value=${settings.choices}
      placeholder="Those in the question" onChange=${(event) => changeSettings({ choices: event.target.value })}></textarea></label>`}
  </details>`;
}
