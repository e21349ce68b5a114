// Starts the page: what comes from the whole window goes to what people do at the page.

import { html, render } from "../vendor/htm-preact.js";
import { Page, isTyping } from "../ui/page.js";
import { choosePicture, forgetLook, loadModels, openJob, redo, restart, undo } from "./asking.js";
import { onKeyWanted } from "./keys.js";
import { get, set } from "./store.js";

onKeyWanted((reason, answer) => set({ keyWanted: { reason, answer } }));

function take(files) {
  const file = [...(files ?? [])].find((each) => each.type.startsWith("image/")) ?? files?.[0];
  if (file) void choosePicture(file, file.name || "pasted picture");
}

addEventListener("dragover", (event) => {
  event.preventDefault();
  document.body.classList.add("dropping");
});
addEventListener("dragleave", (event) => {
  if (!event.relatedTarget) document.body.classList.remove("dropping");
});
addEventListener("drop", (event) => {
  event.preventDefault();
  document.body.classList.remove("dropping");
  take(event.dataTransfer.files);
});
addEventListener("paste", (event) => {
  if (event.clipboardData.files.length) take(event.clipboardData.files);
});
addEventListener("keydown", (event) => {
  if (event.key === "Escape") set({ tool: "select" });
  if (!(event.ctrlKey || event.metaKey) || event.key.toLowerCase() !== "z" || isTyping(event.target)) return;
  event.preventDefault();
  if (event.shiftKey) redo();
  else undo();
});

/** Shows what the address says: a job, the list of jobs, or the start. */
function openAddress() {
  const query = new URLSearchParams(location.search);
  const job = query.get("job");
  if (query.get("view") === "jobs") set({ view: "jobs", problem: null });
  else if (job && get().result?.jobId === job) set({ view: "case", problem: null });
  else if (job) void openJob(job);
  else restart();
}

addEventListener("popstate", () => {
  if (!location.hash) openAddress();
});

addEventListener("pagehide", forgetLook);

render(html`<${Page} />`, document.getElementById("app"));
if (location.search) openAddress();
void loadModels();
