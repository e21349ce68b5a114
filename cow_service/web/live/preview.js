// Runs the worlds of a result again while you drag, a little in each frame of the screen.

import { bodiesOf, cameraOf, countOf, meetingsOf, positionsAlong, runWorlds, sharesOf, verdictOf } from "./world.js";

const [BUDGET, PAUSED_BUDGET] = [9, 14]; // ms of work in a frame of the screen while the aim changes, and while it does not
const MOST_AT_ONCE = 16; // worlds
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const NEAREST = 0.08; // of its first depth: closer than this, a body has passed the camera
const FUTURE_STEP = 2; // recorded positions between two points of a future's line
const BEYOND = 0.3; // of the image: a line ends so far outside

let engine = null; // a promise

/** Loads the engine, once. `wasm` is a promise of its WebAssembly, `load` one of its module. */
export function loadEngine(load, wasm) {
  engine ??= (async () => {
    globalThis.rapierWasm = wasm();
    const R = await load();
    await R.init();
    return R;
  })();
  engine.catch(() => (engine = null));
  return engine;
}

/** How far an upright axis leans in the image, degrees, clockwise; `turn` is a quaternion. */
function leanOf(camera, position, [x, y, z, w]) {
  const axis = [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)];
  const [[ax, ay], [bx, by]] = [-0.01, 0.01].map((side) => camera.project(position.map((value, i) => value + side * camera.height * axis[i])));
  return (Math.atan2(bx - ax, ay - by) * 180) / Math.PI;
}

/** The path of a body of one world in the image: {points, scale, leans, visible}. `start` (px) is where the picture shows it. */
function seen(camera, positions, turns, start) {
  const path = positions.map((position) => camera.project(position));
  const [x0, y0, depth] = path[0];
  const scale = path.map(([, , z]) => depth / Math.max(z, NEAREST * depth));
  const off = start ? [start[0] - x0, start[1] - y0] : [0, 0];
  return { points: path.map(([x, y], i) => [x + scale[i] * off[0], y + scale[i] * off[1]]), scale, leans: turns?.map((turn, i) => leanOf(camera, positions[i], turn)) ?? null, visible: path.map(([, , z]) => z > NEAREST * depth) };
}

export class Preview {
  /** `world` as a result has it; `tell` hears what is known so far: {paths, met, futures, shares, isDone}. */
  constructor(R, world, tell) {
    Object.assign(this, { R, world, tell, count: countOf(world), wanted: null, current: null, each: 2, handle: 0 });
  }

  /** Takes an aim: {direction}, {moved: {body, by}}, {points} of a path, or {} for the worlds as they are; the latest counts. */
  aim(aim) {
    this.wanted = aim;
    this.handle ||= requestAnimationFrame(() => this.work());
  }

  end() {
    cancelAnimationFrame(this.handle);
    this.handle = 0;
    this.wanted = this.current = null;
  }

  work() {
    this.handle = 0;
    if (this.wanted === null) return;
    const isNew = this.wanted !== this.current;
    const until = performance.now() + (isNew ? BUDGET : PAUSED_BUDGET);
    if (isNew) this.begin();
    for (let left = until - performance.now(); this.next < this.count && left > this.each; left = until - performance.now()) this.more(left);
    const { paths, met, futures, verdicts } = this;
    this.tell({ paths, met, futures, shares: sharesOf(this.world, verdicts), isDone: this.next >= this.count });
    if (this.next < this.count || this.wanted !== this.current) this.handle = requestAnimationFrame(() => this.work());
  }

  bodies(k) {
    return bodiesOf(this.world, k, this.current);
  }

  along(k) {
    return this.current.points ? positionsAlong(this.world, k, this.current.points) : null;
  }

  /** The likeliest world. */
  begin() {
    const { R, world } = this;
    this.current = this.wanted;
    const { fps, num_frames: frames, constants } = world;
    const along = this.along(0);
    const [run] = runWorlds(R, constants, [this.bodies(0)], { fps, frames, isAlone: true, along: along && [along] });
    const camera = cameraOf(world, 0);
    const by = this.current.moved?.by ?? [0, 0];
    const bodies = [...new Set([0, ...run.moved])];
    // `from` is where the picture shows it.
    this.paths = bodies.map((body) => ({ body, sprite: world.bodies[body].sprite, ...seen(camera, run.positions[body], world.bodies[body].shape === "sphere" ? null : run.turns[body], body ? null : world.mover.start) }))
      .map((path) => ({ ...path, from: path.body === this.current.moved?.body ? path.points[0].map((value, i) => value - by[i]) : path.points[0] }));
    this.met = meetingsOf(world, run)[0] ?? null;
    this.timing = { fps: constants.clock, every: constants.every };
    Object.assign(this, { next: 1, futures: "", verdicts: [] });
  }

  /** Some more futures, as many as there is time for. */
  more(left) {
    const { R, world, next } = this;
    const { constants, horizon } = world;
    const which = Array.from({ length: clamp(Math.floor(left / this.each), 1, Math.min(MOST_AT_ONCE, this.count - next)) }, (_, i) => next + i);
    const began = performance.now();
    const along = this.current.points ? which.map((k) => this.along(k)) : null;
    const runs = runWorlds(R, constants, which.map((k) => this.bodies(k)), {
      fps: constants.clock, frames: Math.ceil(horizon * constants.clock) + 1, every: constants.every, along, turns: world.asked?.relation === "tips",
      pathFps: world.fps,
    });
    runs.forEach((run, place) => {
      this.verdicts.push(verdictOf(world, run, which[place], this.timing));
      this.futures += this.lineOf(which[place], run.positions[0]);
    });
    this.next += which.length;
    this.each = Math.min(BUDGET / 2, (performance.now() - began) / which.length); // ms for a world
  }

  lineOf(k, positions) {
    const [width, height] = this.world.size;
    const { points, visible } = seen(cameraOf(this.world, k), positions, null, this.paths[0].points[0]);
    let text = "";
    for (let i = 0; i < points.length; i += FUTURE_STEP) {
      const [x, y] = points[i];
      const isOut = !visible[i] || x < -BEYOND * width || x > (1 + BEYOND) * width || y < -BEYOND * height || y > (1 + BEYOND) * height;
      if (isOut) break;
      text += `${text ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`;
    }
    return text;
  }
}
