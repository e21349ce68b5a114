// Which questions are shown, and in which order.
const OUTCOMES = {
  "By most repeats": {
    right: "right", wrong: "not right", helped: "helped: only the arm is right", hurt: "hurt: only the other is right",
    "both-right": "both right", "both-wrong": "both not right",
  },
  "In any repeat": {
    "helped-any": "helped in a repeat", "hurt-any": "hurt in a repeat", abstained: "abstained", unreadable: "unreadable",
    imagined: "rests on a simulation", refused: "simulation refused", failed: "failed: no reply",
    disagree: "read differently by the paper's rules",
  },
};
const SORTS = {
  data: "as in the data", helped: "most helped first", hurt: "most hurt first", slow: "slowest first",
  likely: "highest told probability first", unlikely: "lowest told probability first",
};
const COMPARING = new Set(["helped", "hurt", "both-right", "both-wrong", "helped-any", "hurt-any"]);
const EMPTY = { q: "", replies: "", task: "", level: "", arm: "", against: "", outcome: "", sort: "data", page: "1", item: "" };

function armNamed(name) {
  const place = arms.findIndex((arm) => arm.name === name);
  return place < 0 ? null : place;
}

// The arm that is looked at, and the one that it is compared with.
function chosenArms(state) {
  const first = Math.max(0, arms.findIndex((arm) => arm.against !== null));
  const one = armNamed(state.arm) ?? first;
  return [one, armNamed(state.against) ?? arms[one].against];
}

function differs(one, other, wanted) {
  for (const [repeat, right] of one.rightIn) {
    if (right === wanted && other.rightIn.get(repeat) === !wanted) return true;
  }
  return false;
}

function hasOutcome(outcome, one, other) {
  if (COMPARING.has(outcome)) {
    if (!other || !one.replies || !other.replies) return false;
    if (outcome === "helped") return one.mostRight && !other.mostRight;
    if (outcome === "hurt") return !one.mostRight && other.mostRight;
    if (outcome === "both-right") return one.mostRight && other.mostRight;
    if (outcome === "both-wrong") return !one.mostRight && !other.mostRight;
    return differs(one, other, outcome === "helped-any");
  }
  if (outcome === "right") return one.replies > 0 && one.mostRight;
  if (outcome === "wrong") return one.replies > 0 && !one.mostRight;
  return one[outcome] > 0;
}

function inReplies(item, words) {
  const texts = repliesOf(item.place);
  return item.seen.some((of) => of.some((one) => one.reply !== null && texts[one.reply].toLowerCase().includes(words)));
}

function chosenItems(state) {
  const [one, other] = chosenArms(state);
  const words = state.q.trim().toLowerCase();
  const found = items.filter((item) =>
    (!state.item || item.id === state.item) &&
    (!state.task || item.task === state.task) &&
    (!state.level || item.level === state.level) &&
    (!state.outcome || hasOutcome(state.outcome, item.tallies[one], other === null ? null : item.tallies[other])) &&
    (!words || item.text.includes(words) || (state.replies && inReplies(item, words))));
  return sorted(found, state.sort, one, other);
}

function sorted(found, sort, one, other) {
  const share = (item, arm) => arm === null ? 0 : item.tallies[arm].right / Math.max(1, item.tallies[arm].replies);
  const gain = (item) => share(item, one) - share(item, other);
  const told = (item, without) => item.tallies[one].probability ?? without;
  const keys = {
    helped: (item) => -gain(item), hurt: gain,
    slow: (item) => -item.tallies[one].seconds / Math.max(1, item.tallies[one].replies),
    likely: (item) => -told(item, -1), unlikely: (item) => told(item, 2),
  };
  const key = keys[sort];
  if (!key) return found;
  return found.map((item) => [key(item), item]).sort(([a], [b]) => a - b).map(([, item]) => item);
}

function readHash() {
  const given = new URLSearchParams(location.hash.slice(1));
  return Object.fromEntries(Object.entries(EMPTY).map(([key, value]) => [key, given.get(key) ?? value]));
}

function hashOf(state) {
  const given = Object.entries(state).filter(([key, value]) => value !== EMPTY[key]);
  return `#${new URLSearchParams(given)}`;
}
