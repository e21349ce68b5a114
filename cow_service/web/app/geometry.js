// Boxes, paths and arrows in pixels of the image.

export const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
export const rounded = (value, digits = 1) => Number(value.toFixed(digits));
export const LEAST_BOX = 4; // px: a smaller one was a click

/** The box [x0, y0, x1, y1] between two points, inside the image. */
export function boxBetween([ax, ay], [bx, by], { width, height }) {
  const xs = [clamp(Math.min(ax, bx), 0, width), clamp(Math.max(ax, bx), 0, width)];
  const ys = [clamp(Math.min(ay, by), 0, height), clamp(Math.max(ay, by), 0, height)];
  return [xs[0], ys[0], xs[1], ys[1]].map((value) => rounded(value));
}

export const isBox = ([x0, y0, x1, y1]) => x1 - x0 >= LEAST_BOX && y1 - y0 >= LEAST_BOX;

/** A box whose corner, side or middle was moved. `handle` is such as "nw", "e" or "all". */
export function movedBox(box, handle, dx, dy, size) {
  let [x0, y0, x1, y1] = box;
  if (handle === "all") {
    const mx = clamp(dx, -x0, size.width - x1);
    const my = clamp(dy, -y0, size.height - y1);
    return [x0 + mx, y0 + my, x1 + mx, y1 + my].map((value) => rounded(value));
  }
  if (handle.includes("w")) x0 = clamp(x0 + dx, 0, x1 - LEAST_BOX);
  if (handle.includes("e")) x1 = clamp(x1 + dx, x0 + LEAST_BOX, size.width);
  if (handle.includes("n")) y0 = clamp(y0 + dy, 0, y1 - LEAST_BOX);
  if (handle.includes("s")) y1 = clamp(y1 + dy, y0 + LEAST_BOX, size.height);
  return [x0, y0, x1, y1].map((value) => rounded(value));
}

/** Whether two boxes are the same but for rounding; a box that is not there is like no other. */
export const isSameBox = (a, b) => Boolean(a && b) && a.every((value, place) => Math.abs(value - b[place]) < 1);

export const middleOf = ([x0, y0, x1, y1]) => [(x0 + x1) / 2, (y0 + y1) / 2];

/** A unit vector from one point to another; null where they are too near. */
export function directionBetween([ax, ay], [bx, by], least = 6) {
  const length = Math.hypot(bx - ax, by - ay);
  return length < least ? null : [rounded((bx - ax) / length, 4), rounded((by - ay) / length, 4)];
}

/** How far the tip of the arrow is from the object: the same share of the picture as in the server's overlay. */
export const arrowReach = ({ width, height }) => 0.14 * Math.max(width, height);

/** The tip of an arrow, inside the picture as long as that leaves something of the arrow. */
export function tipOf([x, y], [dx, dy], size) {
  const most = arrowReach(size);
  const room = (at, step, end) => (step > 0 ? (0.98 * end - at) / step : step < 0 ? (0.02 * end - at) / step : most);
  const reach = clamp(Math.min(room(x, dx, size.width), room(y, dy, size.height)), 0.35 * most, most);
  return [x + dx * reach, y + dy * reach];
}

const HANDLE_DISTANCE = 0.06; // of the image's longer side: between two handles of a path

/** Frames at which a path has a handle: evenly along the part that is seen. */
export function waypointFrames({ points, visible }, { width, height }, most = 5) {
  const out = visible.indexOf(false);
  const seen = out < 0 ? points.length : out;
  const along = [0];
  for (let i = 1; i < seen; i += 1) along.push(along[i - 1] + Math.hypot(points[i][0] - points[i - 1][0], points[i][1] - points[i - 1][1]));
  const length = along.at(-1) ?? 0;
  const count = Math.min(most, Math.floor(length / (HANDLE_DISTANCE * Math.max(width, height))));
  const frames = Array.from({ length: count }, (_, place) => along.findIndex((value) => value >= ((place + 1) * length) / count - 1e-6));
  return [...new Set(frames)].filter((frame) => frame > 0);
}

/** Whether a point is so far from all others. */
export const isFree = ([x, y], others, least) => others.every(([ox, oy]) => Math.hypot(x - ox, y - oy) >= least);

/** The points of a path after one was moved: its neighbours follow, less and less up to the next handles. */
export function pulledPath(points, frames, place, [dx, dy]) {
  const frame = frames[place];
  const before = place === 0 ? 0 : frames[place - 1];
  const after = place === frames.length - 1 ? null : frames[place + 1];
  return points.map(([x, y], index) => {
    let share = 0;
    if (index <= frame) share = frame === before ? 1 : clamp((index - before) / (frame - before), 0, 1);
    else share = after === null ? 1 : clamp((after - index) / (after - frame), 0, 1);
    const weight = (1 - Math.cos(Math.PI * share)) / 2;
    return [rounded(x + weight * dx, 2), rounded(y + weight * dy, 2)];
  });
}

const pair = ([x, y]) => `${rounded(x, 1)} ${rounded(y, 1)}`;

/** The visible parts of a path as an SVG path. */
export function lineOf({ points, visible }) {
  let text = "";
  let drawing = false;
  points.forEach((point, index) => {
    if (visible[index]) text += `${drawing ? "L" : "M"}${pair(point)}`;
    drawing = visible[index];
  });
  return text;
}

const WIDEST_BAND = 0.25; // of the image's longer side: worlds that went different ways have no common path

/** Whether a box of a band is small enough to say something of the path. */
export const saysWhere = ([x0, y0, x1, y1], { width, height }) => Math.max(x1 - x0, y1 - y0) <= WIDEST_BAND * Math.max(width, height);

/** The area in which the path of most worlds lies, as an SVG path: each frame's box, joined to the next one's. */
export function bandOf({ band, visible }, size) {
  let text = "";
  for (let index = 0; index + 1 < band.length; index += 1) {
    if ((!visible[index] && !visible[index + 1]) || !saysWhere(band[index], size) || !saysWhere(band[index + 1], size)) continue;
    const corners = hull([...cornersOf(band[index]), ...cornersOf(band[index + 1])]);
    text += `M${corners.map(pair).join("L")}Z`;
  }
  return text;
}

const SQUARE = 0.25; // side of a square of the floor's grid, over the camera's height
const NEAREST = 0.05; // depth of what is drawn, over the camera's height
const LEAST_GAP = 2.5; // CSS px between two lines: farther away they would run together

const radians = (degrees) => (degrees * Math.PI) / 180;

/** Where the horizon crosses the middle of the picture, px down. */
export const horizonOf = ({ focal, pitch }, { height }) => height / 2 - focal * Math.tan(radians(pitch));

/** The floor that a camera {focal, pitch, roll} sees as a grid, and its horizon: SVG paths. The camera's height drops out of both. */
export function floorGrid(camera, size, unit) {
  const { focal } = camera;
  const [sine, cosine] = [Math.sin(radians(camera.pitch)), Math.cos(radians(camera.pitch))];
  const [s, c] = [Math.sin(radians(camera.roll)), Math.cos(radians(camera.roll))];
  const reach = Math.hypot(size.width, size.height) / 2;
  // From the middle of the picture, before the camera rolls.
  const line = (x0, y0, x1, y1) => [[x0, y0], [x1, y1]].map(([x, y]) => pair([size.width / 2 + c * x + s * y, size.height / 2 - s * x + c * y])).join("L");
  const horizon = horizonOf(camera, size) - size.height / 2;
  const farthest = Math.sqrt((focal * SQUARE) / (LEAST_GAP * unit)); // depth; between lines there, dy = focal * SQUARE / depth^2
  const down = (ahead) => (focal * (cosine - ahead * sine)) / (ahead * cosine + sine);
  const [first, last] = [NEAREST, farthest].map((depth) => Math.floor((depth - sine) / cosine / SQUARE));
  const lines = [];
  for (let row = first + 1; row <= last; row += 1) lines.push(line(-reach, down(row * SQUARE), reach, down(row * SQUARE)));
  const far = last * SQUARE * cosine + sine; // depth of the last row
  const columns = Math.ceil((reach * far) / focal / SQUARE);
  const near = down((NEAREST - sine) / cosine);
  for (let column = -columns; column <= columns; column += 1) {
    const x = column * SQUARE * focal;
    lines.push(line(x / NEAREST, near, x / far, down(last * SQUARE)));
  }
  return { grid: lines.map((each) => `M${each}`).join(""), horizon: `M${line(-2 * reach, horizon, 2 * reach, horizon)}` };
}

const cornersOf = ([x0, y0, x1, y1]) => [[x0, y0], [x1, y0], [x1, y1], [x0, y1]];

/** The convex hull of some points (Andrew's monotone chain), all in the same turn. */
function hull(points) {
  const sorted = [...points].sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  const half = (ordered) => {
    const chain = [];
    for (const point of ordered) {
      while (chain.length > 1 && turn(chain.at(-2), chain.at(-1), point) <= 0) chain.pop();
      chain.push(point);
    }
    return chain.slice(0, -1);
  };
  return [...half(sorted), ...half(sorted.reverse())];
}

const turn = (a, b, c) => (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
