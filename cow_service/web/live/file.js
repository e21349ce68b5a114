// The page of one world that is passed on as a file: its arrow is dragged, and the worlds are computed on the spot.

import { directionBetween, lineOf, tipOf } from "../app/geometry.js";
import { shareWords } from "../app/words.js";
import { Preview, loadEngine } from "./preview.js";

const KEYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const KEY_STEP = 0.01; // of the picture's longer side
const PAUSE = 0.6; // s between the end of the film and its next beginning
const NAMESPACE = "http://www.w3.org/2000/svg";

const svg = document.querySelector("svg");
const told = document.getElementById("told");

function drawn(name, attributes) {
  const element = document.createElementNS(NAMESPACE, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  svg.append(element);
  return element;
}

/** Shows a world; `load` and `wasm` bring the engine. */
export async function show(world, load, wasm) {
  const size = { width: world.size[0], height: world.size[1] };
  const unit = Math.max(size.width, size.height) / 700;
  const trajectory = { bodies: world.bodies.map(({ name }) => ({ object: name })) };
  const origin = world.mover.start;
  const [futures, halo, path, pushed, met] = ["futures", "halo", "path", "path pushed", "met"].map((name) => drawn("path", { class: name }));
  const things = world.bodies.map(({ sprite: { href, box: [x0, y0, x1, y1] } }) => drawn("image", { href, x: x0, y: y0, width: x1 - x0, height: y1 - y0, visibility: "hidden" }));
  const arrow = drawn("path", { class: "arrow" });
  const reach = drawn("circle", { class: "reach", r: 24 * unit, tabindex: 0, role: "button", "aria-label": "Tip of the direction arrow. Arrow keys move it." });
  const tip = drawn("circle", { class: "tip", r: 7 * unit });
  let direction = world.mover.direction;
  let found = null;
  let isAimed = false; // before, the worlds are those of the result

  const preview = new Preview(await loadEngine(load, wasm), world, (now) => {
    found = now;
    const line = (paths) => paths.map(lineOf).join("");
    futures.setAttribute("d", now.futures);
    halo.setAttribute("d", line(now.paths));
    path.setAttribute("d", line(now.paths.slice(0, 1)));
    pushed.setAttribute("d", line(now.paths.slice(1)));
    const box = now.met ? world.bodies[now.met.body].bbox : null;
    met.setAttribute("d", box ? `M${box[0]} ${box[1]}H${box[2]}V${box[3]}H${box[0]}Z` : "");
    if (!now.shares && isAimed) {
      const hits = now.met ? `It hits the ${world.bodies[now.met.body].name} first.` : "It hits nothing.";
      told.textContent = world.asked ? `${hits} What the question asks is not computed here.` : hits;
    } else if (now.shares) {
      const { agreeing, text } = shareWords(now.shares, trajectory);
      const meter = Object.assign(document.createElement("meter"), { min: 0, max: now.shares.count, value: agreeing });
      told.replaceChildren(meter, text);
    }
  });
  const draw = (to) => {
    const [x, y] = tipOf(origin, to, size);
    direction = to;
    arrow.setAttribute("d", `M${origin}L${x} ${y}`);
    for (const each of [reach, tip]) Object.entries({ cx: x, cy: y }).forEach(([key, value]) => each.setAttribute(key, value));
  };
  const aim = (to) => {
    isAimed = true;
    draw(to);
    preview.aim({ direction: to });
  };
  const point = ({ clientX, clientY }) => {
    const at = new DOMPoint(clientX, clientY).matrixTransform(svg.getScreenCTM().inverse());
    return [at.x, at.y];
  };
  svg.addEventListener("touchstart", (event) => event.target === reach && event.touches.length === 1 && event.preventDefault(), { passive: false });
  reach.addEventListener("pointerdown", (event) => reach.setPointerCapture(event.pointerId));
  reach.addEventListener("pointermove", (event) => {
    const to = reach.hasPointerCapture(event.pointerId) && directionBetween(origin, point(event));
    if (to) aim(to);
  });
  reach.addEventListener("keydown", (event) => {
    const step = KEYS[event.key];
    if (!step) return;
    event.preventDefault();
    const far = KEY_STEP * Math.max(size.width, size.height) * (event.shiftKey ? 4 : 1);
    const [x, y] = tipOf(origin, direction, size);
    aim(directionBetween(origin, [x + step[0] * far, y + step[1] * far]) ?? direction);
  });
  const began = performance.now();
  const isCalm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  requestAnimationFrame(function film(now) {
    const time = isCalm ? Infinity : ((now - began) / 1000) % (world.num_frames / world.fps + PAUSE);
    things.forEach((thing, body) => {
      const path = found?.paths.find((each) => each.body === body);
      const at = path ? Math.max(0, Math.min(path.points.length - 1, Math.floor(time * world.fps))) : 0;
      thing.setAttribute("visibility", path?.visible[at] ? "visible" : "hidden");
      if (!path) return;
      const [x, y] = path.points[at];
      const turn = path.leans ? path.leans[at] - path.leans[0] : 0;
      thing.setAttribute("transform", `translate(${x} ${y}) rotate(${turn}) scale(${path.scale[at]}) translate(${-path.from[0]} ${-path.from[1]})`);
    });
    requestAnimationFrame(film);
  });
  draw(direction);
  preview.aim({});
}
