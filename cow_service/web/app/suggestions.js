// Questions made of what was found in a picture.

import { middleOf } from "./geometry.js";

const MOST = 3;

const area = ([x0, y0, x1, y1]) => (x1 - x0) * (y1 - y0);

/** Questions about the objects of a picture: {object, bbox} each. */
export function suggestionsOf(bodies) {
  const named = bodies.filter((body) => body.object && body.object !== "object");
  const small = [...named].sort((a, b) => area(a.bbox) - area(b.bbox));
  const questions = [];
  for (const mover of small) {
    const [x, y] = middleOf(mover.bbox);
    const others = named.filter((body) => body !== mover);
    const isBall = mover.object.endsWith("ball"); // anything else more likely stands than hangs
    const below = isBall && others.find(({ bbox }) => bbox[0] < x && x < bbox[2] && bbox[1] > mover.bbox[3]);
    if (below) questions.push(`If the ${mover.object} falls freely, will it land on the ${below.object}?`);
    const beside = others
      .filter(({ bbox }) => bbox[1] < mover.bbox[3] && bbox[3] > mover.bbox[1])
      .sort((a, b) => Math.abs(middleOf(a.bbox)[0] - x) - Math.abs(middleOf(b.bbox)[0] - x))[0];
    if (beside) {
      const side = middleOf(beside.bbox)[0] > x ? "right" : "left";
      questions.push(`If the ${mover.object} moves to the ${side}, will it hit the ${beside.object}?`);
    }
    if (!below && !beside) questions.push(`If the ${mover.object} moves to the ${x < y ? "right" : "left"}, what does it hit first?`);
  }
  return [...new Set(questions)].slice(0, MOST);
}

/** What a sentence can say that a thing does, by the words of the choice; `ways`: it says which way, too. */
export const CHANGES = {
  moves: { says: (thing, way) => `the ${thing} moves ${way}`, ways: true },
  "is thrown": { says: (thing, way) => `the ${thing} is thrown ${way}`, ways: true },
  falls: { says: (thing) => `the ${thing} falls freely` },
  "is taken away": { says: (thing, way, first) => `the ${thing} is removed and the ${first} moves ${way}`, ways: true, needsMover: true },
};
const WAYS = ["to the right", "to the left", "away from the camera", "towards the camera", "along the arrow"];
export const OUTCOMES = { hit: "it hit", hide: "it hide", "land on": "it land on" };

/** The ways that a thing can go: also towards each other thing. */
export const waysOf = (others) => [...WAYS, ...others.map((other) => `towards the ${other}`)];

/** A question of the parts of the builder. */
export function sentenceOf({ thing, change, way, mover, outcome, target }) {
  return `If ${CHANGES[change].says(thing, way, mover)}, will ${OUTCOMES[outcome]} the ${target}?`;
}
