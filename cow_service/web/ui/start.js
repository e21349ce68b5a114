// Where a picture comes from: dropped, pasted, chosen, photographed, or an example.

import { html } from "../vendor/htm-preact.js";
import { address } from "../app/address.js";
import { choosePicture } from "../app/asking.js";
import { set } from "../app/store.js";

const TYPES = "image/png,image/jpeg,image/webp";

const EXAMPLES = [
  ["ball-and-mug", "If the yellow ball moves opposite to the direction of the arrow, will it hit the blue mug?"],
  ["falling-ball", "If the black ball falls freely from its current position, will it land on the orange cylinder?"],
  ["bottle-passes-cylinder", "If the red bottle moves in the direction of the arrow, will the white cylinder be occluded at some moment?"],
  ["thrown-ball", "If the pink ball is thrown in the direction of the arrow, will it hit the white cube?"],
];

const exampleAddress = (name) => address(`/web/examples/${name}.jpg`);

async function takeExample(name, question) {
  const response = await fetch(exampleAddress(name));
  if (response.ok) await choosePicture(await response.blob(), `${name}.jpg`, question);
  else set({ problem: { code: "no-example", title: "That example is not there.", detail: `The server answered ${response.status}.`, errors: [] } });
}

function chosen(event) {
  const [file] = event.target.files;
  event.target.value = "";
  if (file) void choosePicture(file, file.name);
}

/** Buttons that bring a picture. */
export function Choose({ short = false }) {
  return html`<div class="choose row">
    <label class="button ${short ? "" : "primary"}">${short ? "Another picture" : "Choose a picture"}<input type="file" accept=${TYPES} onChange=${chosen} /></label>
    <label class="button camera">Take a photograph<input type="file" accept="image/*" capture="environment" onChange=${chosen} /></label>
  </div>`;
}

export function Start() {
  return html`<section class="start" aria-label="Choose a picture">
    <h1>Look before you answer.</h1>
    <p>Give a picture and ask what would happen. The service finds what moves, computes where it goes, shows it, and answers after it has looked.</p>
    <div class="drop"><p>Drop or paste a picture here</p><${Choose} /></div>
    <h2>Or try one of these</h2>
    <ul class="examples">${EXAMPLES.map(([name, question]) => html`<li key=${name}><button onClick=${() => takeExample(name, question)}>
      <img src=${exampleAddress(`${name}-small`)} alt="" width="400" height="300" /><span>${question}</span></button></li>`)}</ul>
  </section>`;
}
