// What can be dragged over the picture, by pointer, touch and arrow keys.

import { html, useRef } from "../vendor/htm-preact.js";
import { isFree } from "../app/geometry.js";

const KEYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const KEY_STEP = 3; // CSS px; ten times with Shift
const KEY_PAUSE = 700; // ms without a key before what was moved is taken

/** A point of the screen in pixels of the image. */
export function pointIn(svg, event) {
  const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
  return [at.x, at.y];
}

/** Properties of an SVG element that is dragged. `unit` is the size of a CSS pixel in px of the image. `onMove` and `onEnd` hear (dx, dy) in px since the drag began. */
export function useDrag(unit, onMove, onEnd) {
  const drag = useRef(null);
  const keys = useRef({ dx: 0, dy: 0, timer: 0 });
  const latest = useRef();
  latest.current = { onMove, onEnd };
  return {
    onPointerDown(event) {
      if (event.button || !event.isPrimary) return;
      event.stopPropagation();
      event.currentTarget.setPointerCapture(event.pointerId);
      drag.current = pointIn(event.currentTarget.ownerSVGElement, event);
      const target = event.currentTarget;
      const breakOff = (key) => {
        if (key.key !== "Escape" || !drag.current) return;
        drag.current = null;
        target.blur();
        latest.current.onEnd(0, 0);
      };
      addEventListener("keydown", breakOff);
      target.addEventListener("lostpointercapture", () => removeEventListener("keydown", breakOff), { once: true });
    },
    onPointerMove(event) {
      if (!drag.current) return;
      const [x, y] = pointIn(event.currentTarget.ownerSVGElement, event);
      latest.current.onMove(x - drag.current[0], y - drag.current[1]);
    },
    onPointerUp(event) {
      if (!drag.current) return;
      const [x, y] = pointIn(event.currentTarget.ownerSVGElement, event);
      const [dx, dy] = [x - drag.current[0], y - drag.current[1]];
      drag.current = null;
      event.currentTarget.blur(); // released: the coming film may play
      latest.current.onEnd(dx, dy);
    },
    onPointerCancel() {
      drag.current = null;
      latest.current.onEnd(0, 0);
    },
    onKeyDown(event) {
      const step = KEYS[event.key];
      if (event.key === "Escape" && (keys.current.dx || keys.current.dy)) {
        clearTimeout(keys.current.timer);
        keys.current = { dx: 0, dy: 0, timer: 0 };
        latest.current.onEnd(0, 0);
      }
      if (!step) return;
      event.preventDefault();
      event.stopPropagation();
      const moved = keys.current;
      const size = (event.shiftKey ? 10 * KEY_STEP : KEY_STEP) * unit;
      moved.dx += step[0] * size;
      moved.dy += step[1] * size;
      latest.current.onMove(moved.dx, moved.dy);
      clearTimeout(moved.timer);
      moved.timer = setTimeout(() => {
        const { dx, dy } = moved;
        keys.current = { dx: 0, dy: 0, timer: 0 };
        latest.current.onEnd(dx, dy);
      }, KEY_PAUSE);
    },
  };
}

const [REACH, CORNER_REACH] = [18, 12]; // CSS px around the middle of a handle that take hold of it
export const APART = REACH + CORNER_REACH; // CSS px: handles that are nearer would cover each other

/** A round handle. `unit` is the size of a CSS pixel in pixels of the image. */
export function Handle({ at, unit, label, kind, reach = REACH, onMove, onEnd }) {
  const drag = useDrag(unit, onMove, onEnd);
  return html`<g class=${`handle ${kind}`} tabindex="0" role="button" aria-label=${`${label} Arrow keys move it.`} aria-roledescription="handle" ...${drag}>
    <title>${label}</title>
    <circle class="reach" cx=${at[0]} cy=${at[1]} r=${reach * unit} />
    <circle class="knob" cx=${at[0]} cy=${at[1]} r=${(kind.startsWith("corner") ? 4.5 : 6.5) * unit} />
  </g>`;
}

/** The corners of a box that lie too near to other handles. */
export const coveredCorners = (box, others, unit) => Object.keys(CORNERS).filter((corner) => !isFree(CORNERS[corner].map((i) => box[i]), others, APART * unit));

const CORNERS = { nw: [0, 1], ne: [2, 1], se: [2, 3], sw: [0, 3] };
const CORNER_NAMES = { nw: "Upper left", ne: "Upper right", se: "Lower right", sw: "Lower left" };

/** A box that can be moved, and a handle at each corner that is not `covered`. `onMove` and `onEnd` hear (handle, dx, dy). */
export function BoxHandles({ box, unit, name, kind, covered = [], onMove, onEnd }) {
  const drag = useDrag(unit, (dx, dy) => onMove("all", dx, dy), (dx, dy) => onEnd("all", dx, dy));
  const [x0, y0, x1, y1] = box;
  const reach = Math.min(CORNER_REACH, Math.min(x1 - x0, y1 - y0) / (2.1 * unit));
  return html`<g>
    <rect class=${`grip ${kind}`} x=${x0} y=${y0} width=${Math.max(0, x1 - x0)} height=${Math.max(0, y1 - y0)} tabindex="0" role="button"
      aria-label=${`Box of ${name}. Arrow keys move it.`} aria-roledescription="handle" ...${drag} />
    ${Object.entries(CORNERS).map(([corner, [ix, iy]]) => !covered.includes(corner) && html`<${Handle} key=${corner} at=${[box[ix], box[iy]]} unit=${unit} reach=${reach} kind=${`corner ${kind}`}
      label=${`${CORNER_NAMES[corner]} corner of ${name}.`} onMove=${(dx, dy) => onMove(corner, dx, dy)} onEnd=${(dx, dy) => onEnd(corner, dx, dy)} />`)}
  </g>`;
}
