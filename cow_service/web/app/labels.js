// Where names go over the picture: beside their boxes, inside the picture, not over one another.

const HEIGHT = 17; // CSS px of a line
const CHARACTER = 8; // CSS px of a character, on the average
const MOST = 36; // characters of a name

const short = (text) => (text.length > MOST ? `${text.slice(0, MOST - 1)}…` : text);

const overlap = (a, b) => a.x < b.x + b.width && b.x < a.x + a.width && a.y < b.y + b.height && b.y < a.y + a.height;

/** Labels {text, box, kind, below} with their places {x, y, width, height} in pixels of the image; the first ones choose first. */
export function placed(labels, unit, size) {
  const done = [];
  for (const label of labels) {
    const text = short(label.text);
    const [width, height] = [text.length * CHARACTER * unit, HEIGHT * unit];
    const x = Math.max(2 * unit, Math.min(label.box[0], size.width - width - 2 * unit));
    const [above, below] = [label.box[1] - height - unit, label.box[3] + unit];
    const sides = label.below ? [below, below + height, above] : [above, above - height, below, below + height];
    const places = sides.filter((y) => y >= 0 && y + height <= size.height).map((y) => ({ x, y, width, height }));
    const free = places.find((one) => !done.some((other) => overlap(one, other)));
    if (!free && label.kind === "body") continue; // a crowd: its boxes are drawn all the same
    const place = free ?? places[0] ?? { x, y: Math.max(0, Math.min(above, size.height - height)), width, height };
    done.push({ ...label, ...place, text });
  }
  return done;
}
