// One card per question. All texts are data of others: they become text nodes, never markup.
const MARKS = { right: "✓", wrong: "✕", abstained: "–", unreadable: "?", failed: "!" };
const WORDS = { right: "right", wrong: "wrong", abstained: "not sure", unreadable: "unreadable", failed: "failed, no reply" };

function make(tag, given = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(given)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== null && value !== undefined && value !== false) element.setAttribute(name, value);
  }
  element.append(...children.flat().filter((child) => child !== null && child !== undefined));
  return element;
}

function heard(text) {
  return make("span", { class: "heard" }, text);
}

function picture(place, alt) {
  const address = core.pictures[place];
  if (!address) return make("p", { class: "missing" }, `${alt}: the file is missing`);
  const image = make("img", { src: address, alt, loading: "lazy", decoding: "async" });
  return make("a", { href: address, target: "_blank", rel: "noopener" }, image);
}

function questionBlock(item) {
  const block = make("div", { class: "asked", dir: "auto" }, item.question[0]);
  item.options.forEach(([letter, text], place) => {
    const right = letter === item.answer;
    const mark = right ? [make("span", { class: "mark right" }, `✓ ${letter}, the right option`)] : [];
    block.append(make("span", { class: right ? "option right-option" : "option" }, make("bdi", {}, text), " ", ...mark), item.question[place + 1]);
  });
  if (item.options.length === 0) block.append(make("p", {}, `Right: ${item.answer}`));
  return block;
}

function chip(item, one) {
  const state = stateOf(item, one);
  const letter = one.read ?? "";
  return make("li", {}, make("span", { class: `mark ${state}` },
    heard(`Repeat ${one.repeat}: `), `${MARKS[state]} ${letter}`.trim(), heard(` ${WORDS[state]}`)));
}

// The pictures that were shown, once for all repeats in which they were the same.
function shownBlocks(observations) {
  const groups = new Map();
  for (const one of observations) {
    const key = `${one.shown} ${one.overlay}`;
    groups.set(key, [...(groups.get(key) ?? []), one]);
  }
  return [...groups.values()].filter(([one]) => one.frames.length || one.overlay !== null).map((same) => {
    const of = groups.size > 1 ? `, repeat${same.length > 1 ? "s" : ""} ${same.map((one) => one.repeat).join(", ")}` : "";
    const frames = same[0].frames.map((place, number) => picture(place, `Frame ${number + 1}${of}`));
    const overlay = same[0].overlay === null ? [] : [picture(same[0].overlay, `Overlay${of}`)];
    const caption = `${frames.length} frame${frames.length === 1 ? "" : "s"} shown${overlay.length ? ", and the overlay" : ""}${of}`;
    return make("figure", {}, make("div", { class: "frames" }, frames, overlay), make("figcaption", {}, caption));
  });
}

function orderText(item, one) {
  const asData = item.options.map(([letter]) => letter).join("");
  if (one.order === asData) return "Options in the order of the data.";
  const texts = new Map(item.options);
  return "Options as shown: " + [...one.order].map((letter, place) =>
    `${item.options[place]?.[0] ?? place + 1} = ${letter} of the data (${texts.get(letter) ?? ""})`).join("; ") + ".";
}

function replyBlock(item, one) {
  const state = stateOf(item, one);
  const paper = one.failure === undefined && one.paper !== one.read ? ` The paper's rules read ${one.paper ?? "nothing"}.` : "";
  const read = one.read === null ? "" : ` ${one.read}`;
  return make("div", { class: "reply" },
    make("h5", {}, `Repeat ${one.repeat}: `, make("span", { class: `mark ${state}` }, `${MARKS[state]}${read} ${WORDS[state]}`)),
    make("p", { class: "hint" }, make("bdi", {}, orderText(item, one)), `${paper} ${one.seconds.toFixed(1)} s.`),
    one.refusal === undefined ? null : make("p", { class: "warning" }, `Simulation refused: ${one.refusal}`),
    one.failure === undefined
      ? make("pre", { dir: "auto" }, repliesOf(item.place)[one.reply] ?? "(no text)")
      : make("p", { class: "problem" }, `No reply: ${one.failure}`));
}

function repliesDetails(item, observations) {
  const inside = make("div", {});
  const details = make("details", {}, make("summary", {}, `Replies (${observations.length})`), inside);
  details.addEventListener("toggle", () => {
    if (details.open && !inside.hasChildNodes()) inside.append(...observations.map((one) => replyBlock(item, one)));
  });
  return details;
}

function toldText(observations) {
  const one = observations.find((each) => each.probability !== null);
  if (!one) return null;
  const happens = one.happens === null ? "" : one.happens ? "; it happens" : "; it does not happen";
  return make("p", { class: "hint" }, `Told probability: ${(100 * one.probability).toFixed(0)}%${happens}.`);
}

function armBlock(item, place) {
  const observations = item.seen[place];
  const found = item.tallies[place];
  const head = make("h4", {}, arms[place].name);
  if (!observations.length) return make("section", { class: "arm" }, head, make("p", { class: "hint" }, "Not asked."));
  const reasons = [...new Set(observations.map((one) => one.refusal).filter((reason) => reason !== undefined))];
  const failures = [...new Set(observations.map((one) => one.failure).filter((reason) => reason !== undefined))];
  return make("section", { class: "arm" }, head,
    make("p", { class: "hint" }, `${found.right} of ${found.replies} right`),
    make("ul", { class: "chips" }, observations.map((one) => chip(item, one))),
    reasons.map((reason) => make("p", { class: "warning" }, `Simulation refused: ${reason} (${found.refused})`)),
    failures.map((reason) => make("p", { class: "problem" }, `Failed: ${reason}`)),
    toldText(observations), shownBlocks(observations), repliesDetails(item, observations));
}

function card(item) {
  const named = item.scene === item.source ? [item.scene] : [item.scene, item.source];
  const facts = [item.task, item.level, ...named, ...(core.data.length > 1 ? [item.data] : [])];
  return make("article", { class: "card" },
    make("header", { class: "about" },
      make("h3", {}, make("a", { href: `#${new URLSearchParams({ item: item.id })}` }, item.id)),
      make("ul", {}, facts.map((fact) => make("li", {}, fact)))),
    make("div", { class: "question" }, make("div", { class: "image" }, picture(item.image, `Picture of question ${item.id}`)), questionBlock(item)),
    item.oracle.length ? make("details", {}, make("summary", {}, "What really happens"),
      make("div", { class: "frames" }, item.oracle.map((place, number) => picture(place, `What really happens, picture ${number + 1}`)))) : null,
    make("div", { class: "arms" }, arms.map((_, place) => armBlock(item, place))));
}
