// The filters as a form, their state in the address, and the cards of one page of what they leave.
const PER_PAGE = 25;
const form = document.getElementById("filters");
const cards = document.getElementById("cards");
let state = readHash();
let typing = 0;

function select(name, label, groups) {
  const options = groups.flatMap(([group, entries]) => {
    const made = entries.map(([value, text]) => make("option", { value }, text));
    return group ? [make("optgroup", { label: group }, made)] : made;
  });
  return make("label", {}, label, make("select", { name }, options));
}

function buildForm() {
  const kinds = (key) => [...new Set(items.map((item) => item[key]))].sort().map((each) => [each, each]);
  const names = arms.map((arm) => [arm.name, arm.name]);
  const outcomes = Object.entries(OUTCOMES).map(([group, entries]) => [group, Object.entries(entries)]);
  form.append(
    select("task", "Task", [["", [["", "all"], ...kinds("task")]]]),
    select("level", "Level", [["", [["", "all"], ...kinds("level")]]]),
    select("arm", "Arm", [["", names]]),
    select("outcome", "Its outcome", [["", [["", "any"]]], ...outcomes]),
    select("against", "Compared with", [["", [["", "its baseline"], ...names]]]),
    select("sort", "Order", [["", Object.entries(SORTS)]]),
    make("label", {}, "Search", make("input", { type: "search", name: "q", autocomplete: "off" })),
    make("label", { class: "check" }, make("input", { type: "checkbox", name: "replies", value: "1" }), "in the replies, too"),
    make("button", { type: "reset" }, "Clear"));
  document.getElementById("legend").append(...Object.keys(MARKS).map((each) =>
    make("li", {}, make("span", { class: `mark ${each}` }, `${MARKS[each]} ${WORDS[each]}`))));
}

function fillForm() {
  for (const field of form.elements) {
    if (field.type === "checkbox") field.checked = state[field.name] !== "";
    else if (field.name === "arm") field.value = arms[chosenArms(state)[0]].name;
    else if (field.name) field.value = state[field.name];
  }
}

function show() {
  const found = chosenItems(state);
  const pages = Math.max(1, Math.ceil(found.length / PER_PAGE));
  const page = Math.min(pages, Math.max(1, Number.parseInt(state.page, 10) || 1));
  cards.replaceChildren(...found.slice((page - 1) * PER_PAGE, page * PER_PAGE).map(card));
  const only = state.item ? `, only ${state.item}` : "";
  document.getElementById("count").textContent = `${found.length} of ${items.length} questions${only}`;
  document.getElementById("page").textContent = `Page ${page} of ${pages}`;
  document.getElementById("back").disabled = page === 1;
  document.getElementById("on").disabled = page === pages;
}

// Typing replaces the entry of the history; a page or a link adds one.
function go(changes, add = false) {
  state = { ...state, page: "1", ...changes };
  history[add ? "pushState" : "replaceState"](null, "", hashOf(state));
  show();
}

function toHeading(id) {
  const heading = document.getElementById(id);
  heading.scrollIntoView();
  heading.focus({ preventScroll: true });
}

function turn(by) {
  go({ page: String((Number.parseInt(state.page, 10) || 1) + by) }, true);
  toHeading("items-heading");
}

function fromAddress() {
  state = readHash();
  fillForm();
  show();
}

form.addEventListener("change", ({ target }) => {
  if (target.name !== "q") go({ [target.name]: target.type === "checkbox" ? (target.checked ? "1" : "") : target.value, item: "" });
});
form.addEventListener("input", ({ target }) => {
  if (target.name !== "q") return;
  clearTimeout(typing);
  typing = setTimeout(() => go({ q: target.value, item: "" }), 120);
});
form.addEventListener("submit", (event) => event.preventDefault());
form.addEventListener("reset", (event) => {
  event.preventDefault();
  go({ ...EMPTY });
  fillForm();
});
document.getElementById("back").addEventListener("click", () => turn(-1));
document.getElementById("on").addEventListener("click", () => turn(1));
document.getElementById("skip").addEventListener("click", (event) => {
  event.preventDefault();
  toHeading("items-heading");
});
for (const button of document.querySelectorAll("[data-to]")) {
  button.addEventListener("click", () => toHeading(button.dataset.to));
}
addEventListener("popstate", fromAddress);
// A link to a view of the questions shows them, wherever on the page it stands.
document.addEventListener("click", ({ target }) => {
  const link = target.closest?.("a[href^='#']:not(.skip)");
  if (link) setTimeout(() => toHeading("items-heading"));
});

buildForm();
fromAddress();
if (location.hash.length > 1) toHeading("items-heading");
