// The worlds of a result run again, with another aim: the same physics as the server's, by the same engine, but for two
// things: bodies that overlap part faster, and those that have left the picture may come back into it.
//
// `world` is the JSON that a result names as `trajectory.live`, its constants with it. Coordinates are metres right, above
// the floor and ahead, the camera above their origin. World 0 is the likeliest; the others are those of the ensemble.

const CHECKED = 4; // recorded frames after which it is asked what is far away, and whether all rests
const SPACING = 24; // m inside the engine, between worlds
const COLOURS = 4; // worlds so many places apart share a collision group: the engine has sixteen here
const REACH = 0.9 * COLOURS * SPACING / 2; // m inside the engine: what would get further away is taken out
const ROLLS = "sphere";

const at = (column, k) => (Array.isArray(column) ? column[k] : column);
const vector = (columns, k) => columns.map((column) => at(column, k));
const norm = (v) => Math.hypot(...v);
const scaled = (v, factor) => v.map((value) => value * factor);
const unit = (v) => scaled(v, 1 / Math.max(norm(v), 1e-12));
const minus = (a, b) => a.map((value, i) => value - b[i]);
const plus = (a, b) => a.map((value, i) => value + b[i]);
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

/** How many worlds there are: the likeliest and the ensemble. */
export const countOf = (world) => world.worlds + 1;

/** The camera of one world. */
export function cameraOf(world, k) {
  const [width, height] = world.size;
  const focal = at(world.cameras.focal, k);
  const axes = vector(world.cameras.axes, k);
  const above = at(world.cameras.height, k);
  const row = (i) => axes.slice(3 * i, 3 * i + 3);
  return {
    focal,
    height: above,
    ray([x, y]) {
      const seen = [(x - width / 2) / focal, (y - height / 2) / focal, 1];
      return [0, 1, 2].map((i) => row(i).reduce((sum, value, j) => sum + value * seen[j], 0));
    },
    project([right, up, ahead]) {
      const from = [right, up - above, ahead];
      const seen = [0, 1, 2].map((j) => from.reduce((sum, value, i) => sum + value * axes[3 * i + j], 0));
      const z = Math.max(seen[2], 1e-3 * above);
      return [(seen[0] * focal) / z + width / 2, (seen[1] * focal) / z + height / 2, seen[2]];
    },
    over: (way) => [0, 1, 2].map((i) => row(i).reduce((sum, value, j) => sum + value * way[j], 0)),
  };
}

// --- how the mover sets out

const turned = ([x, y], angle) => [Math.cos(angle) * x - Math.sin(angle) * y, Math.sin(angle) * x + Math.cos(angle) * y];

/** A unit vector, seen in a direction of the image, in a vertical plane turned from that of the image (radians). */
function inPlane(camera, centre, halfWidth, direction, turn) {
  const level = [Math.sign(direction[0] || 1) * Math.cos(turn), 0, Math.sin(turn)];
  const up = [0, 1, 0];
  const step = 1e-4 * halfWidth;
  const scale = camera.project(centre)[2] / camera.focal;
  const [[a, c], [b, d]] = [level, up].map((way) => {
    const [before, after] = [-step, step].map((side) => camera.project(plus(centre, scaled(way, side))));
    return [0, 1].map((i) => ((after[i] - before[i]) / (2 * step)) * scale);
  });
  const [p, q, r, s] = [a + 1e-9, b, c, d + 1e-9];
  const det = p * s - q * r;
  const shares = [(s * direction[0] - q * direction[1]) / det, (p * direction[1] - r * direction[0]) / det];
  return unit(plus(scaled(level, shares[0]), scaled(up, shares[1])));
}

function outOfImage(camera, direction, depth) {
  const across = Math.sqrt(1 - depth * depth);
  return camera.over([direction[0] * across, direction[1] * across, depth]);
}

function alongFloor(camera, mover, direction, depth, low) {
  if (depth) {
    const way = outOfImage(camera, direction, depth);
    return unit([way[0], 0, way[2]]);
  }
  const [x, y, z] = camera.project(mover.position);
  const step = (camera.focal / z) * mover.seen * 0.05;
  const ends = [-step, step].map((side) => camera.ray([x + side * direction[0], y + side * direction[1]]));
  const isLow = -ends[0][1] / norm(ends[0]) < low;
  const drop = camera.height - mover.position[1] + (isLow ? mover.half_height : 0);
  const hits = ends.map((ray) => scaled(ray, drop / Math.max(-ray[1], 1e-3)));
  const way = minus(hits[1], hits[0]);
  return unit([way[0], 0, way[2]]);
}

/** A drawn direction leaves open how far a throw leads into the picture: see `_thrown` in physics/lift.py. */
function thrown(world, k, camera, bodies, direction) {
  const { constants: c, mover: aim } = world;
  const mover = bodies[0];
  const [mean, sigma] = [Math.asin(aim.depth), aim.depth_sigma];
  let turn = mean;
  if (sigma > 0) {
    const bump = (value) => Math.exp(-0.5 * value * value);
    const sense = Math.sign(direction[0]);
    const bearings = bodies.slice(1).map((body) => Math.atan2(body.position[2] - mover.position[2], sense * (body.position[0] - mover.position[0])));
    const turns = Array.from({ length: c.turns }, (_, i) => -c.widest_turn + (2 * c.widest_turn * i) / (c.turns - 1));
    const weights = turns.map((each) => {
      const way = inPlane(camera, mover.position, mover.seen, direction, mean + sigma * each);
      const usual = bump((Math.asin(clamp(way[1], -1, 1)) - c.rise) / c.rise_sigma);
      const aimed = bearings.reduce((sum, bearing) => sum + c.aimed * bump((mean + sigma * each - bearing) / c.aim_sigma), 1);
      return (bump(each) + c.unusual) * (usual + c.unusual) * aimed;
    });
    const total = weights.reduce((sum, value) => sum + value, 0);
    const share = at(aim.heading, k);
    let [below, last] = [0, null];
    turn = mean + sigma * turns.at(-1);
    for (let i = 0; i < weights.length; i += 1) {
      const here = (below + weights[i] / 2) / total;
      if (share <= here) {
        const part = last === null ? 1 : (share - last) / (here - last);
        turn = mean + sigma * (last === null ? turns[0] : turns[i - 1] + part * (turns[i] - turns[i - 1]));
        break;
      }
      below += weights[i];
      last = here;
    }
  }
  return inPlane(camera, mover.position, mover.seen, direction, clamp(turn, -1.5, 1.5));
}

/** The velocity (m/s) of the mover of one world, seen in a direction of the image. */
export function velocityOf(world, k, bodies, direction) {
  const { mover: aim, constants: c } = world;
  const speed = at(aim.speed, k);
  if (aim.is_side_view) {
    const [dx, dy] = direction;
    return scaled(unit(aim.stands && aim.kind === "linear" && !aim.rises ? [dx, 0, 0] : [dx, -dy, 0]), speed);
  }
  const camera = cameraOf(world, k);
  const seen = turned(direction, c.turn_sigma * at(aim.turn, k));
  let way;
  if (aim.kind === "projectile") way = thrown(world, k, camera, bodies, seen);
  else if (aim.rises) way = inPlane(camera, bodies[0].position, bodies[0].seen, seen, Math.asin(aim.depth));
  else if (aim.stands) way = alongFloor(camera, bodies[0], seen, aim.depth, c.low);
  else way = outOfImage(camera, seen, aim.depth);
  return scaled(way, speed);
}

const MEASURES = ["half_width", "half_depth", "half_height", "yaw", "density", "friction", "restitution", "base", "waist", "middle"];

/** The bodies of one world as they begin: with another `direction`, or with one `moved` in the picture, {body, by: [dx, dy]} px. */
export function bodiesOf(world, k, { direction = null, moved = null } = {}) {
  const bodies = world.bodies.map((body) => ({
    ...body,
    ...Object.fromEntries(MEASURES.map((name) => [name, body[name] === null ? null : at(body[name], k)])),
    position: vector(body.position, k),
    velocity: vector(body.velocity, k),
    seen: at(body.half_width, k),
  }));
  bodies[0].seen = at(world.mover.seen_half_width, k);
  bodies[0].course = courseOf(world, k);
  if (moved) move(world, k, bodies, moved);
  if (direction) {
    const mover = bodies[0];
    mover.velocity = velocityOf(world, k, bodies, direction);
    if (mover.course) mover.course.legs[0].velocity = mover.velocity;
  }
  return bodies;
}

/** What the mover of one world does until it meets something: {halts, legs: [{until (s), velocity}]}; null where it just goes on. */
function courseOf({ course }, k) {
  let until = 0;
  return course && { halts: course.halts, legs: course.legs.map(({ duration, velocity }) => {
    until += duration === null ? Infinity : at(duration, k);
    return { until, velocity: vector(velocity, k) };
  }) };
}

/** The mean velocity of a course between two times (s): with it, steps of any length lead to the same places. */
function meanVelocity({ legs }, start, end) {
  let begin = 0;
  let moved = [0, 0, 0];
  for (const { until, velocity } of legs) {
    const inside = Math.min(end, until) - Math.max(start, begin);
    if (inside > 0) moved = plus(moved, scaled(velocity, inside));
    begin = until;
  }
  return scaled(moved, 1 / (end - start));
}

/** A body that is dragged over the picture stays at its height above the floor: nearer it is smaller. What it carries comes with it. */
function move(world, k, bodies, { body, by }) {
  const camera = cameraOf(world, k);
  const dragged = bodies[body];
  const [x, y, depth] = camera.project(dragged.position);
  const ray = camera.ray([x + by[0], y + by[1]]);
  const rises = !dragged.falls || world.mover.is_side_view || ray[1] > -0.02;
  const reach = rises ? depth : (camera.height - dragged.position[1]) / -ray[1];
  const there = plus(scaled(ray, reach), [0, camera.height, 0]);
  const gone = minus(there, dragged.position);
  bodies.forEach((each, index) => {
    let on = index;
    for (let steps = 0; on !== null && on !== body && steps < bodies.length; steps += 1) on = bodies[on].support;
    if (on === body) each.position = plus(each.position, gone);
  });
}

// --- the engine

function collidersOf(R, body, scale, leastWaist) {
  const [width, depth, height] = [body.half_width, body.half_depth, body.half_height].map((half) => half * scale);
  const density = body.middle === null ? body.density : 0;
  if (body.pieces.length) {
    return body.pieces.map((corners) => {
      const points = corners.flatMap(([x, y]) => [-depth, depth].flatMap((z) => [x * scale, y * scale, z]));
      return R.ColliderDesc.convexHull(new Float32Array(points)).setDensity(body.density);
    });
  }
  if (body.shape === "sphere") return [R.ColliderDesc.ball(width).setDensity(density)];
  if (body.shape === "box") return [R.ColliderDesc.cuboid(width, height, depth).setDensity(density)];
  if (body.shape === "cone") return [R.ColliderDesc.cone(height, width).setDensity(density)];
  if (body.base >= 1) return [R.ColliderDesc.cylinder(height, width).setDensity(density)];
  const low = Math.max(body.waist, leastWaist) * height;
  return [
    R.ColliderDesc.cylinder(low, body.base * width).setTranslation(0, low - height, 0).setDensity(density),
    R.ColliderDesc.cylinder(height - low, width).setTranslation(0, low, 0).setDensity(density),
  ];
}

const SHARES = { box: 8, cylinder: 2 * Math.PI, cone: (2 * Math.PI) / 3, sphere: (4 * Math.PI) / 3 };

/** Of a solid body whose centre of mass is not in its middle: as heavy as if it were of one stuff. */
function massOf(body, scale) {
  const [width, depth, height] = [body.half_width, body.half_depth, body.half_height].map((half) => half * scale);
  const mass = body.density * SHARES[body.shape] * width * depth * height;
  const [w, d, h] = [width ** 2, depth ** 2, height ** 2];
  const spread = body.shape === "box" ? 3 : 4;
  const inertia = { x: mass * (d / spread + h / 3), y: (mass * (w + d)) / spread, z: mass * (w / spread + h / 3) };
  return [mass, { x: 0, y: (2 * body.middle - 1) * height, z: 0 }, inertia, { x: 0, y: 0, z: 0, w: 1 }];
}

const combined = (R, collider) => collider.setFrictionCombineRule(R.CoefficientCombineRule.Multiply)
  .setRestitutionCombineRule(R.CoefficientCombineRule.Multiply);

const standsOn = (one, other, rests) => {
  const gap = one.position[1] - one.half_height - other.position[1] - other.half_height;
  return Math.abs(gap) < rests * Math.min(one.half_height, other.half_height);
};

/** Runs worlds side by side, each a list of bodies, for so many frames at a rate; `along` are positions [frames] that the mover of each follows.

Returns for each {positions: [body][frame], turns, meetings: [{time, a, b}], moved}; after the last frame nothing moves any more. */
export function runWorlds(R, constants, worlds, { fps, frames, every = 1, isAlone = false, along = null, turns = isAlone, pathFps = fps }) {
  const c = constants;
  const substeps = Math.max(1, Math.ceil((isAlone ? c.least_steps : c.least_steps_of_many) / fps));
  const step = 1 / (fps * substeps);
  const scale = c.engine_size / worlds[0][0].half_width;
  const engine = new R.World({ x: 0, y: -Math.min(c.gravity * scale, c.most_gravity), z: 0 });
  const queue = new R.EventQueue(true);
  try {
    engine.timestep = step;
    engine.createCollider(combined(R, new R.ColliderDesc(new R.HalfSpace({ x: 0, y: 1, z: 0 }))).setFriction(c.floor_friction).setRestitution(c.floor_restitution));
    const side = Math.ceil(Math.sqrt(worlds.length));
    const owner = new Map();
    const made = worlds.map((bodies, k) => {
      const cell = [(k % side) - (side - 1) / 2, Math.floor(k / side) - (side - 1) / 2].map((place) => place * SPACING);
      const [x, , z] = bodies[0].position;
      const origin = [cell[0] - x * scale, 0, cell[1] - z * scale];
      const group = 1 << ((k % side % COLOURS) * COLOURS + (Math.floor(k / side) % COLOURS));
      const rigid = bodies.map((body, i) => addBody(R, engine, body, { scale, origin, group, c, follows: i === 0 && along !== null }));
      rigid.forEach((each, i) => {
        for (let n = 0; n < each.numColliders(); n += 1) owner.set(each.collider(n).handle, [k, i]);
      });
      return {
        isGhost: along !== null, course: along ? null : bodies[0].course, bodies, rigid, origin, meetings: [], touching: new Map(), glides: new Set(bodies.flatMap((body, i) => (body.glides && body.starts ? [i] : []))),
        gone: new Set(), moved: new Set(bodies.flatMap((body, i) => (body.starts ? [i] : []))),
        positions: bodies.map((body) => [body.position]), velocities: bodies.map((body) => body.velocity), turns: bodies.map(() => [[0, 0, 0, 1]]),
      };
    });
    // What glides slowly from the start is not at rest.
    const slowOf = (body) => Math.min(c.at_rest * body.half_width, body.glides && body.starts ? norm(body.velocity) / 2 : Infinity);
    const slow = made.map(({ bodies }) => bodies.map(slowOf));
    const follow = along && made.map(({ origin }, k) => ({ origin, path: along[k] }));
    let stillSince = 0;
    const rows = Math.floor((frames - 1) / every);
    for (let row = 1; row <= rows; row += 1) {
      for (let n = (row - 1) * every * substeps; n < row * every * substeps; n += 1) {
        if (follow) follow.forEach(({ origin, path }, k) => {
          const [x, y, z] = plus(scaled(pointAlong(path, ((n + 1) / (substeps * fps)) * pathFps), scale), origin);
          made[k].rigid[0].setNextKinematicTranslation({ x, y, z });
        });
        for (const world of made) if (world.course) steer(world, n * step, step, scale);
        engine.step(queue);
        queue.drainCollisionEvents((first, second, started) => meet(made, owner, c, n * step, first, second, started));
      }
      const isStill = record(made, { scale, step: every / fps, turns, slow });
      stillSince = isStill && !along && !made.some(({ course }) => course) ? stillSince + 1 : 0;
      if (row % CHECKED === 0) takeOut(made, scale, (CHECKED * every) / fps);
      if (stillSince >= 2 && row % CHECKED === 0) break;
    }
    return made.map(({ positions, turns: all, meetings, moved }) => ({ positions, turns: all, meetings, moved }));
  } finally {
    queue.free();
    engine.free();
  }
}

function addBody(R, engine, body, { scale, origin, group, c, follows }) {
  const [x, y, z] = plus(scaled(body.position, scale), origin);
  const desc = follows ? R.RigidBodyDesc.kinematicPositionBased() : body.fixed ? R.RigidBodyDesc.fixed() : R.RigidBodyDesc.dynamic();
  desc.setTranslation(x, y + (body.falls && !follows ? c.gap : 0), z).setRotation({ x: 0, y: Math.sin(body.yaw / 2), z: 0, w: Math.cos(body.yaw / 2) });
  desc.setGravityScale(body.falls && !follows ? 1 : 0);
  if (body.starts || follows) {
    const [vx, vy, vz] = scaled(body.velocity, scale);
    desc.setLinvel(vx, vy, vz).setCcdEnabled(true).setSoftCcdPrediction(c.foreseen).setCanSleep(!body.glides);
    if (body.glides && body.shape === ROLLS) desc.setAngvel({ x: vz / (body.half_width * scale), y: 0, z: -vx / (body.half_width * scale) });
  } else {
    desc.setSleeping(true);
  }
  if (body.middle !== null) desc.setAdditionalMassProperties(...massOf(body, scale));
  const rigid = engine.createRigidBody(desc);
  for (const part of collidersOf(R, body, scale, c.least_waist)) {
    combined(R, part).setFriction(body.glides ? 0 : body.friction).setRestitution(body.restitution).setSensor(follows)
      .setCollisionGroups((group << 16) | group).setActiveEvents(R.ActiveEvents.COLLISION_EVENTS);
    if (follows) part.setActiveCollisionTypes(R.ActiveCollisionTypes.ALL);
    engine.createCollider(part, rigid);
  }
  return rigid;
}

/** Notes that two bodies begin to touch: what glides is subject to friction from then on. */
function meet(made, owner, c, time, first, second, started) {
  const [one, other] = [owner.get(first), owner.get(second)].filter(Boolean).sort((a, b) => a[1] - b[1]);
  if (!one) return;
  const [k, a] = one;
  const b = other ? other[1] : null;
  const world = made[k];
  const pair = `${a} ${b}`;
  const before = world.touching.get(pair) ?? 0;
  world.touching.set(pair, started ? before + 1 : Math.max(0, before - 1));
  if (!started || before) return;
  world.meetings.push({ time, a, b });
  if (b === null || (world.isGhost && a === 0) || (!world.moved.has(a) && !world.moved.has(b))) return;
  world.moved.add(a).add(b);
  const [lower, upper] = [world.bodies[a], world.bodies[b]];
  if (time < c.at_start && (standsOn(lower, upper, c.rests) || standsOn(upper, lower, c.rests))) return;
  for (const i of [a, b]) {
    if (!world.glides.has(i)) continue;
    const halts = i === 0 && world.course?.halts;
    release(world, i);
    if (halts) for (const stopped of [a, b].map((each) => world.rigid[each])) {
      stopped.setLinvel({ x: 0, y: 0, z: 0 }, true);
      stopped.setAngvel({ x: 0, y: 0, z: 0 }, true);
    }
  }
}

/** A body glides no more: from now on it is subject to friction. */
function release(world, i) {
  world.glides.delete(i);
  if (i === 0) world.course = null;
  for (let n = 0; n < world.rigid[i].numColliders(); n += 1) world.rigid[i].collider(n).setFriction(world.bodies[i].friction);
}

/** Has the mover follow its course for one step (s). */
function steer(world, time, step, scale) {
  const { course, bodies: [body], rigid: [rigid] } = world;
  if (course.legs.some(({ until }) => until > time - 1.5 * step && until < time + step)) {
    const [x, y, z] = scaled(meanVelocity(course, time, time + step), scale);
    rigid.setLinvel({ x, y: body.falls ? rigid.linvel().y : y, z }, true);
    const radius = body.half_width * scale;
    if (body.shape === ROLLS && body.falls) rigid.setAngvel({ x: z / radius, y: 0, z: -x / radius }, true);
  }
  if (course.legs.at(-1).until <= time) release(world, 0);
}

/** Writes down where all bodies are; returns whether none moves. */
function record(made, { scale, step, turns, slow }) {
  let isStill = true;
  made.forEach((world, k) => world.rigid.forEach((rigid, i) => {
    const path = world.positions[i];
    if (world.gone.has(i)) {
      path.push(plus(path.at(-1), scaled(world.velocities[i], step)));
      if (turns) world.turns[i].push(world.turns[i].at(-1));
      return;
    }
    if (!world.moved.has(i) && rigid.isSleeping()) {
      path.push(path.at(-1));
      if (turns) world.turns[i].push(world.turns[i].at(-1));
      return;
    }
    const [p, v] = [rigid.translation(), rigid.linvel()];
    const here = [(p.x - world.origin[0]) / scale, p.y / scale, (p.z - world.origin[2]) / scale];
    path.push(here);
    world.velocities[i] = [v.x / scale, v.y / scale, v.z / scale];
    if (norm(world.velocities[i]) >= slow[k][i]) {
      isStill = false;
      if (norm(minus(here, path[0])) > slow[k][i]) world.moved.add(i);
    }
    if (turns) {
      const q = rigid.rotation();
      world.turns[i].push([q.x, q.y, q.z, q.w]);
    }
  }));
  return isStill;
}

/** Leaves out what would get into other worlds: it keeps its last velocity over the floor. */
function takeOut(made, scale, ahead) {
  for (const world of made) world.rigid.forEach((rigid, i) => {
    if (world.gone.has(i) || !world.moved.has(i)) return;
    const [x, , z] = plus(world.positions[i].at(-1), scaled(world.velocities[i], ahead));
    const [mx, , mz] = world.bodies[0].position;
    if (Math.max(Math.abs(x - mx), Math.abs(z - mz)) * scale <= REACH) return;
    rigid.setEnabled(false);
    world.gone.add(i);
    world.velocities[i][1] = 0;
  });
}

const pointAlong = (path, place) => {
  const to = Math.min(place, path.length - 1);
  const low = Math.min(Math.floor(to), path.length - 2);
  return plus(path[low], scaled(minus(path[low + 1], path[low]), to - low));
};

// --- what happens in them

const DECIDED = new Set(["touches", "lands", "moves", "tips", "leaves"]);
const upright = ([x, , z]) => 1 - 2 * (x * x + z * z); // of a quaternion: how far up an upright axis still points

/** When each body of a world is set in motion, s: {body: time}. */
function setOff(world, run) {
  const moving = new Map(world.bodies.flatMap((body, i) => (body.starts || i === 0 ? [[i, 0]] : [])));
  for (const { a, b, time } of run.meetings) {
    if (b === null) continue;
    for (const [one, other] of [[a, b], [b, a]]) if (moving.has(one) && !moving.has(other) && run.moved.has(other)) moving.set(other, time);
  }
  return moving;
}

/** When a body that moves and others first touch, none of what it stands on: [{body, time}], in the order of their times. */
export function meetingsOf(world, run, subject = 0) {
  const { support } = world.bodies[subject];
  const since = subject ? setOff(world, run).get(subject) ?? Infinity : 0;
  const own = run.meetings.filter(({ a, b, time }) => b !== null && (a === subject || b === subject) && time >= since);
  const others = own.map(({ a, b, time }) => ({ body: a === subject ? b : a, time }));
  return others.filter(({ body }, place) => body !== support && others.findIndex((each) => each.body === body) === place);
}

/** Whether the mover of a world began where no picture shows one: inside another body, or beside what carries it. */
function isMisread(world, run, k) {
  const [mover] = world.bodies;
  if (world.bodies.some((body) => body.pieces.length)) return false; // drawings show what touches
  if (mover.support !== null) {
    const carrier = world.bodies[mover.support];
    const [dx, dz] = [0, 2].map((axis) => at(mover.position[axis], k) - at(carrier.position[axis], k));
    if (Math.hypot(dx, dz) > Math.max(at(carrier.half_width, k), at(carrier.half_depth, k))) return true;
  }
  return run.meetings.some(({ a, b, time }) => a === 0 && b !== null && time < world.constants.at_start && b !== mover.support && world.bodies[b].support !== 0);
}

/** Per body, when the event in question happens with it in one world. */
function timesOf(world, run, k, { fps, every }) {
  const { asked, constants: c, horizon } = world;
  const step = every / fps;
  const first = (path, holds) => {
    const row = path.findIndex(holds);
    return row < 0 ? Infinity : row * step;
  };
  const meant = (body) => (asked.target !== null ? body === asked.target : asked.among.length ? asked.among.includes(body) : body !== asked.subject && body !== 0 && body !== world.bodies[asked.subject].support);
  const { relation, subject } = asked;
  const camera = relation === "leaves" ? cameraOf(world, k) : null;
  const [width, height] = world.size;
  const met = relation === "touches" ? new Map(meetingsOf(world, run, subject).map(({ body, time }) => [body, time])) : null;
  return world.bodies.map((_, body) => {
    let time = Infinity;
    if (relation === "lands" || relation === "leaves") {
      if (body !== subject) return Infinity;
      if (relation === "lands") time = run.meetings.find(({ a, b }) => b === null && a === subject)?.time ?? Infinity;
      else time = first(run.positions[subject], (position) => {
        const [x, y, depth] = camera.project(position);
        return !(x >= 0 && x < width && y >= 0 && y < height && depth > 0);
      });
    } else if (!meant(body)) {
      return Infinity;
    } else if (relation === "touches") {
      time = met.get(body) ?? Infinity;
    } else if (relation === "moves") {
      const [start] = run.positions[body];
      const least = c.displaced * at(world.bodies[body].half_width, k);
      time = first(run.positions[body], (position) => norm(minus(position, start)) > least);
    } else if (world.bodies[body].shape !== ROLLS) {
      time = first(run.turns[body], (turn) => upright(turn) < c.tipped);
    }
    return time <= Math.min(horizon, asked.within ?? horizon) ? time : Infinity;
  });
}

const FIRST_MET = ["which-first", "where", "what-happens"]; // forms of questions whose answer depends on what is met first

/** What one world says to the question: the body that is met first (-1: none), or 1 for yes, 0 for no, and 0.5 where it was misread; null where it cannot say. */
export function verdictOf(world, run, k, timing) {
  const { asked } = world;
  if (!asked || !DECIDED.has(asked.relation) || asked.form === "how-many" || asked.form === "changes") return null;
  const times = timesOf(world, run, k, timing);
  const first = Math.min(...times);
  if (FIRST_MET.includes(asked.form)) return first < Infinity ? times.indexOf(first) : -1;
  if (isMisread(world, run, k)) return 0.5;
  const happens = (asked.every && asked.among.length ? Math.max(...asked.among.map((body) => times[body])) : first) < Infinity;
  return Number(happens !== asked.negated);
}

/** What verdicts of worlds come to: {yes, count, isSure}, also {first} where it is asked what is met first; null where they say nothing. */
export function sharesOf({ asked, mover, constants: c }, verdicts) {
  if (!verdicts.length || verdicts[0] === null) return null;
  const count = verdicts.length;
  const sureOfMiss = mover.kind === "projectile" && mover.depth_sigma > 0 ? c.sure_of_miss : c.sure; // its heading is unknown
  if (!FIRST_MET.includes(asked.form)) {
    const yes = verdicts.reduce((sum, value) => sum + value, 0);
    const isHit = asked.negated ? 2 * yes < count : 2 * yes >= count;
    return { yes: Math.round(yes), count, isSure: Math.max(yes, count - yes) >= (isHit ? c.sure : sureOfMiss) * count };
  }
  const counts = new Map();
  for (const body of verdicts) counts.set(body, (counts.get(body) ?? 0) + 1);
  const [first, yes] = [...counts].sort((one, other) => other[1] - one[1] || other[0] - one[0])[0];
  return { first, yes, count, isSure: yes >= (first < 0 ? sureOfMiss : c.sure) * count };
}

// --- a path that is drawn

/** Positions [frames] along points of the image (px): on the floor for what stands there. */
export function positionsAlong(world, k, points) {
  const { mover: aim, constants: c } = world;
  const [mover] = bodiesOf(world, k);
  const camera = cameraOf(world, k);
  if (!aim.stands) { // in the plane of its depth, seen by a camera as wide as far
    const [width, height] = world.size;
    const metres = aim.metres_per_pixel;
    return points.map(([x, y]) => plus(camera.over([(x - width / 2) * metres, (y - height / 2) * metres, width * metres]), [0, camera.height, 0]));
  }
  const drop = camera.height - mover.position[1] + mover.half_height;
  const nearest = drop / (c.farthest * Math.hypot(mover.position[0], mover.position[2]));
  const deep = at(aim.depth_share, k);
  return points.map(([x, y]) => {
    const ray = camera.ray([x + aim.foot[0] - aim.start[0], y + aim.foot[1] - aim.start[1]]);
    const reach = drop / Math.max(-ray[1], nearest);
    const [right, ahead] = [ray[0] * reach, ray[2] * reach];
    const away = Math.max(Math.hypot(right, ahead), 1e-9);
    const middle = mover.seen * deep;
    return [right + (right / away) * middle, mover.position[1], ahead + (ahead / away) * middle];
  });
}
