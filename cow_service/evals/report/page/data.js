// The data of the page: read once, the texts of the replies only when they are needed.
const core = JSON.parse(document.getElementById("core").textContent);
const arms = core.arms.map(([name, against]) => ({ name, against }));
const blocks = new Map();

function repliesOf(place) {
  const number = Math.floor(place / core.perBlock);
  if (!blocks.has(number)) {
    blocks.set(number, JSON.parse(document.getElementById(`replies-${number}`).textContent));
  }
  return blocks.get(number);
}

function readObservation(told) {
  return {
    ...told, order: told.options.join(""), paper: told.read_as_paper, shown: told.frames.join(),
    refusal: told.refusal ?? undefined, failure: told.failure ?? undefined,
  };
}

function readItem(told, place) {
  const item = { ...told, place, source: told.row, options: told.options.map(({ letter, text }) => [letter, text]) };
  item.seen = told.seen.map((rows) => rows.map(readObservation));
  item.tallies = item.seen.map((of) => tally(item, of));
  item.text = [item.id, item.source, item.scene, questionText(item)].join("\n").toLowerCase();
  return item;
}

function questionText(item) {
  return item.question.reduce((text, part, place) => text + item.options[place - 1][1] + part);
}

// What became of one reply: exactly one of these.
function stateOf(item, one) {
  if (one.failure !== undefined) return "failed";
  if (one.read === null) return "unreadable";
  if (one.read === item.answer) return "right";
  return one.read === item.abstain ? "abstained" : "wrong";
}

function tally(item, observations) {
  const found = { replies: 0, right: 0, wrong: 0, abstained: 0, unreadable: 0, failed: 0, refused: 0, imagined: 0, disagree: 0, seconds: 0 };
  found.rightIn = new Map();
  found.probability = null;
  for (const one of observations) {
    const state = stateOf(item, one);
    found[state] += 1;
    if (state === "failed") continue;
    found.replies += 1;
    found.rightIn.set(one.repeat, state === "right");
    found.refused += one.refusal !== undefined;
    found.imagined += one.imaginations > 0;
    found.disagree += one.paper !== one.read;
    found.seconds += one.seconds;
    found.probability ??= one.probability;
  }
  found.mostRight = 2 * found.right > found.replies;
  return found;
}

const items = core.items.map(readItem);
