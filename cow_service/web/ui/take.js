// What can be taken along: the request as code, the pictures, the clip, the job, a link.

import { html, useState } from "../vendor/htm-preact.js";
import { jobAddress } from "../app/address.js";
import { saveAs } from "../app/artifacts.js";
import { curlOf, jsonOf, pythonOf } from "../app/code.js";
import { currentKey } from "../app/keys.js";
import { requestOf } from "../app/request.js";
import { call } from "../app/server.js";
import { set } from "../app/store.js";

const FORMS = { curl: "curl", python: "Python", json: "JSON" };
const SHARED = { film: ["Film to share", "The film with question, other futures and verdict, at most 3 MB"], card: ["Picture of it", "One moment with question and verdict, for link previews"],
  page: ["Page to play with", "An HTML file whose arrow can be dragged, also without a network"] };
const FILES = { zip: "Everything (zip)", gif: "GIF", webp: "WebP", sheet: "Contact sheet" };
const ENDINGS = { zip: "zip", gif: "gif", webp: "webp", sheet: "png", film: "mp4", card: "jpg", page: "html" };

async function copy(text, done) {
  try {
    await navigator.clipboard.writeText(text);
    done("Copied");
  } catch {
    done("The browser does not allow it: select and copy it yourself.");
  }
}

async function saved(work) {
  try {
    await work();
  } catch (error) {
    if (!error.code) throw error;
    set({ problem: error });
  }
}

const download = (path, name) => saved(async () => saveAs(await (await call(path)).blob(), name));

/** Buttons for what is passed on of a result. */
export function Share({ jobId, simulation }) {
  const has = { film: simulation.video, card: simulation.video, page: simulation.trajectory.live };
  const wanted = Object.entries(SHARED).filter(([format]) => has[format]);
  return wanted.length > 0 && html`<div class="row" role="group" aria-label="To share">${wanted.map(([format, [label, title]]) => html`<button key=${format} title=${title}
    onClick=${() => download(`/jobs/${jobId}/download?format=${format}`, `cow-${jobId}.${ENDINGS[format]}`)}>${label}</button>`)}</div>`;
}

function Code({ state }) {
  const [form, setForm] = useState("curl");
  const [told, setTold] = useState("");
  const request = requestOf(state);
  const file = state.picture.blob?.name ?? (/\.\w+$/.test(state.picture.name) ? state.picture.name : "photo.jpg");
  const text = { curl: () => curlOf(state.settings.kind, request, file, currentKey() !== null), python: () => pythonOf(state.settings.kind, request, file), json: () => jsonOf(request, state.picture.sha256) }[form]();
  return html`<div class="code">
    <div class="row"><div class="segments" role="group" aria-label="Form of the request">
      ${Object.entries(FORMS).map(([name, label]) => html`<button key=${name} aria-pressed=${form === name} onClick=${() => {
        setForm(name);
        setTold("");
      }}>${label}</button>`)}</div>
      <button onClick=${() => copy(text, setTold)}>Copy</button><span role="status">${told}</span></div>
    <pre tabindex="0" role="region" aria-label="The request" dir="ltr">${text}</pre>
  </div>`;
}

export function Take({ state }) {
  const [told, setTold] = useState("");
  const { result } = state;
  const jobId = result?.jobId;
  const simulation = result?.simulation;
  const link = jobId ? new URL(jobAddress(jobId), location.href).href : null;
  return html`<details class="take">
    <summary>Take it along</summary>
    <${Code} state=${state} />
    ${jobId && html`<div class="row" role="group" aria-label="Downloads">
      ${Object.entries(FILES).filter(([format]) => format === "zip" || simulation?.video).map(([format, label]) => html`<button key=${format}
        onClick=${() => download(`/jobs/${jobId}/download?format=${format}`, `cow-${jobId}.${ENDINGS[format]}`)}>${label}</button>`)}
      ${simulation?.video && html`<button onClick=${() => download(`/artifacts/${simulation.video.sha256}`, `cow-${jobId}.mp4`)}>Video</button>`}
      ${simulation && html`<button onClick=${() => download(`/artifacts/${simulation.overlay.sha256}`, `cow-${jobId}-overlay.${simulation.overlay.media_type === "image/png" ? "png" : "jpg"}`)}>Overlay</button>`}
      ${simulation?.frames.map((frame) => html`<button key=${frame.index} onClick=${() => download(`/artifacts/${frame.sha256}`, `cow-${jobId}-frame_${String(frame.index).padStart(3, "0")}.png`)}>Frame ${frame.index}</button>`)}
    </div>
    <div class="row link"><a href=${link}>Link to this view</a><button onClick=${() => copy(link, setTold)}>Copy the link</button><span role="status">${told}</span></div>`}
  </details>`;
}
