// What the models of the server see in the picture: under the pointer, and of what the question names.

import { artifactBlob } from "./artifacts.js";
import { correct } from "./asking.js";
import { moverWith } from "./corrections.js";
import { isSameBox } from "./geometry.js";
import { lightOf } from "./pixels.js";
import { callJson, pause, postJson } from "./server.js";
import { get, set } from "./store.js";

const PAUSE = 0.1; // s between two looks: moving over a bare floor must not keep the server busy

const ARTICLES = ["the", "a", "an"];
const MOST_WORDS = 4; // of a name in a question

const OUTLINING = ["finder", "segmenter"];

/** Whether the server has a model of one of some kinds. Where a look at this picture failed, boxes are drawn as without one. */
export const canSee = ({ models, blind }, kinds = OUTLINING) =>
  !blind && Boolean(models?.perception?.some((each) => kinds.includes(each.kind) && each.default && each.ready !== false));

let sent = { url: null, sha256: null }; // the picture, and a promise of the digest by which the server knows it

async function send(picture) {
  const body = new FormData();
  body.append("image", picture.blob ?? (await artifactBlob(picture.sha256)), "image");
  return (await callJson("/look", { method: "POST", body })).image;
}

function digestOf(picture) {
  if (sent.url !== picture.url) {
    const mine = { url: picture.url, sha256: send(picture) };
    mine.sha256.catch(() => { if (sent === mine) sent = { url: null, sha256: null }; }); // tried again where it is opened again
    sent = mine;
  }
  return sent.sha256;
}

/** Sends the picture, so that the first look at it is fast. */
export const prepare = (picture) => digestOf(picture).catch(() => get().picture?.url === picture.url && set({ blind: true }));

async function lookAt(picture, what) {
  const ask = async () => postJson("/look", { image: { artifact: await digestOf(picture) }, ...what });
  try {
    return await ask();
  } catch (error) {
    if (error.code !== "artifact-not-found") throw error;
    sent = { url: null, sha256: null }; // the server has forgotten it
    return ask();
  }
}

/** The things at {point} or of {question}, with their lights; none where the look fails, null where another picture is shown by now. */
async function thingsOf(what) {
  const { picture } = get();
  const isShown = () => get().picture?.url === picture.url;
  try {
    const { things } = await lookAt(picture, what);
    const lit = await Promise.all(things.map(async (thing) => ({ ...thing, light: thing.mask && (await lightOf(thing.mask)) })));
    return isShown() ? lit : null;
  } catch {
    if (!isShown()) return null;
    set({ blind: true }); // the error is shown with the next request
    return [];
  }
}

const isLit = (point) => get().lit?.things[0]?.light?.covers(point) ?? false;

let wanted = null; // where the pointer is, while an earlier point is looked at: the latest counts
let looking = null; // a promise of the end of that

async function lookAround() {
  while (wanted) {
    const point = wanted;
    wanted = null;
    if (isLit(point)) continue;
    const things = await thingsOf({ point });
    if (things && isOver) set({ lit: { things, others: 0 } });
    await pause(PAUSE);
  }
}

let isOver = false; // the pointer is over the picture

/** Lights what is under the pointer. */
export function pointAt(point) {
  isOver = true;
  wanted = point;
  looking ??= lookAround().then(() => {
    looking = null;
  });
}

/** Lights one thing, or nothing. */
export function light(thing) {
  isOver = false;
  wanted = null;
  set({ lit: thing && { things: [thing], others: 0 } });
}

let clicked = { url: null, point: [0, 0], things: [], place: 0 }; // the last click that found something

/** The thing at a point, null where there is none, undefined where another picture is shown by now; at the same point again, within `reach` px, the next one of those within each other. */
export async function thingAt(point, reach) {
  const { url } = get().picture;
  const isSame = clicked.url === url && Math.hypot(point[0] - clicked.point[0], point[1] - clicked.point[1]) <= reach;
  if (isSame) {
    clicked.place = (clicked.place + 1) % clicked.things.length;
  } else {
    wanted = null;
    await looking;
    const things = isLit(point) ? get().lit.things.filter((thing) => thing.light.covers(point)) : await thingsOf({ point });
    if (get().picture?.url !== url) return undefined;
    if (things?.length) clicked = { url, point, things, place: 0 };
    else clicked.url = null;
  }
  const thing = clicked.url && clicked.things[clicked.place];
  set({ lit: { things: thing ? [thing] : [], others: thing ? clicked.things.length - 1 : 0 } });
  return thing;
}

/** Has something move that was seen or drawn: {bbox, mask, name}. */
export function takeAsMover(thing) {
  const { bbox, mask = null, name = null } = thing;
  const { corrections, result, named, question } = get();
  const simulation = result?.simulation ?? null;
  const known = named.get(question.trim()) ?? [];
  const object = name ?? known.find((each) => isSameBox(each.bbox, bbox))?.name ?? corrections.grounding?.object ?? simulation?.grounding.object;
  const fresh = { ...corrections, grounding: object ? { object } : {} }; // another thing may have another shape
  set({ taken: thing });
  // Where the mover is given no reader looks for what the question asks about: what was found of it is given, too.
  const own = corrections.objects;
  const others = known.filter((each) => each.name !== object && !isSameBox(each.bbox, bbox) && isOnly(each, known)
    && !own.some((other) => other.object === each.name));
  const objects = [...own, ...others.map((each) => ({ object: each.name, bbox: each.bbox, mask: each.mask, role: "target" }))];
  correct({ objects, ...moverWith(simulation, fresh, { bbox, mask }) });
}

const isOnly = ({ name }, things) => things.filter((each) => each.name === name).length === 1;

/** A noun with what stands before it in the question: "blue cube". The server takes things for the same by that. */
function inWords(noun, question) {
  const words = question.toLowerCase().split(/[^\p{L}\p{N}'-]+/u);
  const end = words.indexOf(noun.split(" ").at(-1));
  const start = words.slice(0, Math.max(0, end)).findLastIndex((word) => ARTICLES.includes(word)) + 1;
  return start > 0 && end - start < MOST_WORDS ? words.slice(start, end + 1).join(" ") : noun;
}

/** Looks for what a question names, once for each question. */
export async function lookFor(question) {
  if (get().named.has(question)) return;
  set({ named: new Map(get().named).set(question, []) });
  const things = await thingsOf({ question });
  const inFull = things?.map((each) => (isOnly(each, things) ? { ...each, name: inWords(each.name, question) } : each));
  if (inFull) set({ named: new Map(get().named).set(question, inFull) });
}
