// The simulation that answers while you drag: the paths, the moving object, other futures, and their verdict.

import { html, useEffect, useRef, useState } from "../vendor/htm-preact.js";
import { address } from "../app/address.js";
import { artifactBlob } from "../app/artifacts.js";
import { lineOf } from "../app/geometry.js";
import { shareWords } from "../app/words.js";
import { calm } from "./player.js";

const PAUSE = 0.6; // s between the end of the film and its next beginning
const STATIONS = 5; // places where a thing is drawn at once, where less motion is wanted

/** {R, Preview}: the engine and what runs it, loaded when first wanted. */
async function loaded() {
  const { Preview, loadEngine } = await import("../live/preview.js");
  const R = await loadEngine(() => import("../vendor/rapier.js"), () => fetch(address("/web/vendor/rapier.wasm")));
  return { R, Preview };
}

/** {shown, prepare, aim, end, isLive}: the preview of a result while dragging; nothing if it has no live worlds. */
export function usePreview(simulation) {
  const [shown, show] = useState(null);
  const held = useRef({ preview: null, aim: null, ready: null });
  const live = simulation?.trajectory.live ?? null;
  const end = () => {
    held.current.aim = null;
    held.current.preview?.end();
    show(null);
  };
  useEffect(() => {
    const mine = { preview: null, aim: null, ready: null };
    held.current = mine;
    show(null);
    return () => mine.preview?.end();
  }, [simulation?.id]);
  const prepare = () => {
    const mine = held.current;
    if (!live || mine.ready) return;
    mine.ready = (async () => {
      const [{ R, Preview }, blob] = await Promise.all([loaded(), artifactBlob(live.sha256)]);
      mine.preview = new Preview(R, JSON.parse(await blob.text()), (found) => held.current === mine && mine.aim && show({ of: simulation.id, ...found }));
      if (mine.aim && held.current === mine) mine.preview.aim(mine.aim);
    })();
    mine.ready.catch((error) => console.warn("No preview:", error)); // the server computes the film all the same
  };
  const aim = (wanted) => {
    prepare();
    held.current.aim = wanted;
    held.current.preview?.aim(wanted);
  };
  return { shown: shown?.of === simulation?.id ? shown : null, prepare, aim, end, isLive: live !== null };
}

/** The frame of a film of so many that goes on and on. */
function useFilm(count, fps) {
  const [frame, setFrame] = useState(0);
  useEffect(() => {
    if (calm()) return undefined;
    const began = performance.now();
    let handle = requestAnimationFrame(function tick(now) {
      const time = ((now - began) / 1000) % (count / fps + PAUSE);
      setFrame(Math.max(0, Math.min(count - 1, Math.floor(time * fps))));
      handle = requestAnimationFrame(tick);
    });
    return () => cancelAnimationFrame(handle);
  }, [count, fps]);
  return frame;
}

/** A thing at one frame of its path, cut out of the picture. */
function Thing({ path, frame, isGhost }) {
  const last = Math.min(frame, path.points.length - 1);
  if (!path.visible[last]) return null;
  const [x, y] = path.points[last];
  const turn = path.leans ? path.leans[last] - path.leans[0] : 0;
  const place = `translate(${x} ${y}) rotate(${turn}) scale(${path.scale[last]}) translate(${-path.from[0]} ${-path.from[1]})`;
  const [x0, y0, x1, y1] = path.sprite.box;
  return html`<image class=${isGhost ? "ghost" : "thing"} href=${path.sprite.href} x=${x0} y=${y0} width=${x1 - x0} height=${y1 - y0} transform=${place} />`;
}

export function Foreseen({ shown, trajectory }) {
  const { paths, futures, met } = shown;
  const count = trajectory.paths[0].points.length;
  const frame = useFilm(count, trajectory.fps);
  const stations = calm() ? Array.from({ length: STATIONS }, (_, place) => Math.round(((place + 1) * (count - 1)) / STATIONS)) : [frame];
  const [x0, y0, x1, y1] = met ? trajectory.bodies[met.body].bbox : [];
  return html`<g class="foreseen">
    <path class="futures" d=${futures} />
    ${paths.map((path) => html`<g key=${path.body}><path class="halo" d=${lineOf(path)} /><path class=${path.body ? "path pushed" : "path"} d=${lineOf(path)} /></g>`)}
    ${met && html`<rect class="met touches" x=${x0} y=${y0} width=${x1 - x0} height=${y1 - y0} />`}
    ${stations.map((at) => paths.map((path) => html`<${Thing} key=${`${path.body} ${at}`} path=${path} frame=${at} isGhost=${stations.length > 1} />`))}
  </g>`;
}

/** What the futures say so far, as a bar and in words; `shown` is null where only the server can tell. */
export function Foretold({ shown, trajectory }) {
  if (shown && !shown.shares && !shown.isDone) return null;
  const words = shown?.shares && shareWords(shown.shares, trajectory);
  return html`<p class="foretold" role="status">${words ? html`<meter min="0" max=${shown.shares.count} value=${words.agreeing}></meter> <b>${words.text}</b>`
    : html`<b>Release, and the server computes what happens.</b>`}</p>`;
}
