// Where a picture comes from: dropped, pasted, chosen, photographed, or an example.

import { html, useEffect, useState } from "../vendor/htm-preact.js";
import { address } from "../app/address.js";
import { choosePicture } from "../app/asking.js";
import { set } from "../app/store.js";
import { calm } from "./player.js";


// Each with its question and its answer.
const EXAMPLES = [
  ["ball-and-mug", "If the yellow ball moves opposite to the direction of the arrow, will it hit the blue mug?", "Yes"],
  ["falling-ball", "If the black ball falls freely from its current position, will it land on the orange cylinder?", "Yes"],
  ["bottle-passes-cylinder", "If the red bottle moves in the direction of the arrow, will the white cylinder be occluded at some moment?", "Yes"],
  ["thrown-ball", "If the pink ball is thrown in the direction of the arrow, will it hit the white cube?", "Yes"],
];
const QUIET = 1000; // ms after the page is there: films load after everything that is needed

const exampleAddress = (name) => address(`/web/examples/${name}`);

/** Shows an example and asks its question. */
async function takeExample(name, question) {
  const response = await fetch(exampleAddress(`${name}.jpg`));
  if (!response.ok) return set({ problem: { code: "no-example", title: "That example does not exist.", detail: `The server answered ${response.status}.`, errors: [] } });
  await choosePicture(await response.blob(), `${name}.jpg`, question, true);
  return undefined;
}

/** The still of an example, which then moves by itself where that is wanted. */
function Moving({ name }) {
  const [film, setFilm] = useState(null);
  useEffect(() => {
    if (calm()) return undefined;
    const state = { url: null, isWanted: true };
    const timer = setTimeout(async () => {
      const response = await fetch(exampleAddress(`${name}.mp4`)).catch(() => null); // the still is enough
      if (!response?.ok) return;
      const url = URL.createObjectURL(await response.blob()); // of an address of its own Safari wants ranges
      if (!state.isWanted) return URL.revokeObjectURL(url);
      state.url = url;
      setFilm(url);
    }, QUIET);
    return () => {
      clearTimeout(timer);
      state.isWanted = false;
      if (state.url) URL.revokeObjectURL(state.url);
    };
  }, []);
  return html`<span class="moving"><img src=${exampleAddress(`${name}-small.jpg`)} alt="" width="400" height="300" />
    ${film && html`<video src=${film} muted autoplay loop playsinline tabindex="-1" aria-hidden="true"></video>`}</span>`;
}

function chosen(event) {
  const [file] = event.target.files;
  event.target.value = "";
  if (file) void choosePicture(file, file.name);
}

/** Buttons that bring a picture. */
export function Choose({ short = false }) {
  return html`<div class="choose row">
    <label class="button ${short ? "" : "primary"}">${short ? "Another picture" : "Choose a picture"}<input type="file" accept="image/*" onChange=${chosen} /></label>
    <label class="button camera">Take a photograph<input type="file" accept="image/*" capture="environment" onChange=${chosen} /></label>
  </div>`;
}

export function Start() {
  return html`<section class="start" aria-label="Choose a picture">
    <h1>Look before you answer.</h1>
    <p>Give a picture and ask what would happen. The service finds the moving object, simulates its motion, shows it, and then answers.</p>
    <div class="drop"><p>Drop or paste a picture here</p><${Choose} /></div>
    <h2>Or try one of these</h2>
    <ul class="examples">${EXAMPLES.map(([name, question, answer]) => html`<li key=${name}><button onClick=${() => takeExample(name, question)}>
      <${Moving} name=${name} /><span>${question}</span> <b>${answer}</b></button></li>`)}</ul>
  </section>`;
}
