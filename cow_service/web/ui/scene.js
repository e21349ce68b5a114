// The picture with what was found in it: to look at, to play, and to correct.

import { html, useEffect, useRef, useState } from "../vendor/htm-preact.js";
import { correct } from "../app/asking.js";
import { boxBetween, directionBetween, isBox, isFree, lineOf, middleOf, movedBox, pulledPath, rounded, tipOf, waypointFrames } from "../app/geometry.js";
import { useCutout } from "../app/pixels.js";
import { freeName, groundingOf, isDirected, knownBeside, motionTowards, moverWith, roleOf } from "../app/corrections.js";
import { canSee, light, pointAt, prepare, takeAsMover, thingAt } from "../app/seeing.js";
import { get, set } from "../app/store.js";
import { APART, BoxHandles, Handle, coveredCorners, pointIn } from "./handles.js";
import { Arrow, Labels, Lit, Moment, Rect, World, labelsOf } from "./marks.js";
import { Transport, usePlayer } from "./player.js";
import { Floor, FloorLine } from "./floor.js";
import { Foreseen, Foretold, usePreview } from "./preview.js";
import { Filmstrip } from "./filmstrip.js";
import { Tools } from "./tools.js";

const CLICK = 8; // CSS px: a pointer that moved less has clicked
const LAYERS = { names: true, path: true, band: false, futures: null, floor: false }; // null: where they say something
const AGREED = 0.9; // share of the worlds from which other futures say nothing new

/** The size of a CSS pixel in pixels of the image, as an element is shown now. */
function useUnit(element, width) {
  const [unit, setUnit] = useState(1);
  useEffect(() => {
    const seen = () => {
      const { clientWidth } = element.current;
      if (clientWidth) setUnit(width / clientWidth);
    };
    const observer = new ResizeObserver(seen);
    observer.observe(element.current);
    seen();
    return () => observer.disconnect();
  }, [width]);
  return unit;
}

/** A finger at a handle, or one that draws, does not scroll the page; two zoom it. Browsers honour `touch-action` only on the SVG itself. */
function useTouch(svg, isDrawing) {
  useEffect(() => {
    const { current } = svg;
    const hold = (event) => {
      if (event.touches.length === 1 && (isDrawing || event.target.closest(".handle, .grip"))) event.preventDefault();
    };
    current.addEventListener("touchstart", hold, { passive: false });
    return () => current.removeEventListener("touchstart", hold);
  }, [isDrawing]);
}

export function Scene({ state }) {
  const { picture, result, corrections, tool, found, question, lit, taken } = state;
  const simulation = result?.simulation ?? null;
  const size = { width: picture.width, height: picture.height };
  const frame = useRef(null);
  const svg = useRef(null);
  useTouch(svg, tool !== "select");
  const unit = useUnit(frame, picture.width);
  const [chosen, setLayers] = useState(LAYERS);
  const probability = simulation?.trajectory.outcome?.probability ?? 0.5;
  const layers = { ...chosen, futures: chosen.futures ?? Math.max(probability, 1 - probability) < AGREED };
  const [draft, setDraft] = useState(null);
  const [pending, setPending] = useState(null); // {bbox, mask} of an object that has no name yet
  const busy = useRef(false); // while dragging
  const pressed = useRef([0, 0]); // where the pointer went down, CSS px of the window
  busy.current = draft !== null;
  const player = usePlayer(simulation, () => busy.current || svg.current.contains(document.activeElement));
  const preview = usePreview(simulation);
  const { shown } = preview;
  const cutout = useCutout(picture, simulation?.grounding.mask ?? null, simulation?.grounding.bbox ?? null);

  useEffect(() => {
    setDraft(null);
    setPending(null);
  }, [picture.url]);
  const hasSight = canSee(state);
  const isSeeing = hasSight && (tool === "mover" || tool === "object" || (tool === "select" && !simulation));
  useEffect(() => {
    if (hasSight && picture.blob) void prepare(picture); // that of an opened job is sent once it is needed
  }, [picture.url, hasSight]);
  useEffect(() => light(null), [isSeeing]);
  useEffect(() => void (state.run || draft || preview.end()), [state.run]); // no other film will come
  useEffect(() => void (draft?.direction && foresee({ direction: draft.direction })), [simulation?.id]); // still being dragged
  useEffect(() => set({ isForeseeing: shown !== null }), [shown !== null]);

  const camera = simulation?.trajectory.camera ? { ...simulation.trajectory.camera, ...corrections.camera } : null;
  const isTakenShown = taken?.light && taken.mask === corrections.grounding?.mask && !draft?.mover && (!simulation || state.run);
  const moverBox = draft?.mover ?? corrections.grounding?.bbox ?? simulation?.grounding.bbox ?? null;
  const moverName = corrections.grounding?.object ?? simulation?.grounding.object ?? "what moves";
  const origin = corrections.grounding?.point ?? (draft?.mover || corrections.grounding?.bbox ? middleOf(moverBox) : simulation?.grounding.point ?? null);
  const undirected = corrections.motion?.kind && !isDirected(corrections.motion.kind);
  const known = undirected ? null : corrections.motion?.direction ?? simulation?.motion.direction ?? null;
  const direction = draft?.direction ?? known;
  const path = simulation?.trajectory.paths[0] ?? null;
  // Of handles that would cover each other the arrow's tip comes first, then points of the path; while one is dragged
  // none comes or goes.
  const tips = known && origin ? [tipOf(origin, known, size)] : [];
  const frames = (path ? waypointFrames(path, size) : []).filter((at) => isFree(path.points[at], tips, 1.2 * APART * unit));
  const covered = (box) => coveredCorners(box, [...tips, ...frames.map((at) => path.points[at])], unit);
  const given = corrections.trajectory?.points; // it may not be computed yet
  const base = given && given.length === path?.points.length ? given : path?.points ?? [];
  const points = draft?.points ?? base;
  const editing = !player.playing && tool === "select";

  const ownNames = new Set(corrections.objects.filter((object) => object.bbox).map((object) => object.object));
  const world = simulation ? labelsOf(simulation.trajectory, shown !== null) : found.map((body) => ({ text: body.object, box: body.bbox, kind: "body" }));
  const removed = new Set(corrections.interventions.filter((each) => each.kind === "remove").map((each) => each.object));
  const nameOf = (object) => (removed.has(object) ? `${object}, taken away` : object);
  const labels = [
    ...(moverBox ? [{ text: moverName, box: moverBox, kind: "mover" }] : []),
    ...corrections.objects.map((object, place) => ({ text: nameOf(object.object), box: draft?.object === place ? draft.box : object.bbox, kind: "own" })).filter((label) => label.box),
    ...world.filter((label) => label.kind !== "body" || !ownNames.has(label.text)),
  ];

  const take = (thing) => (tool === "object" ? setPending(thing) : takeAsMover(thing));

  const drawing = {
    onPointerDown(event) {
      if (tool === "select" || event.button) return;
      if (!event.isPrimary) return setDraft(null); // a second finger: nothing is drawn
      event.preventDefault();
      event.currentTarget.setPointerCapture(event.pointerId);
      const at = pointIn(event.currentTarget, event).map((value) => rounded(value));
      setDraft({ tool, from: at, to: at });
    },
    onPointerMove(event) {
      if (!draft?.from) {
        if (isSeeing && !event.buttons && event.pointerType !== "touch") pointAt(pointIn(event.currentTarget, event));
        return;
      }
      const to = pointIn(event.currentTarget, event);
      const aim = draft.tool === "direction" ? { direction: directionBetween(origin ?? draft.from, to) } : { box: boxBetween(draft.from, to, size) };
      setDraft({ ...draft, to, ...aim });
    },
    onPointerUp() {
      if (!draft?.from) return;
      const { box, direction: aimed, from } = draft;
      setDraft(null);
      if (draft.tool !== "direction") {
        const isDrawn = box && isBox(box);
        if (isDrawn) take({ bbox: box });
        if (isDrawn || !isSeeing) set({ tool: "select" }); // else it was a click
      } else if (aimed) {
        const place = origin ? {} : moverWith(simulation, corrections, { point: from });
        correct({ ...place, motion: motionTowards(simulation, corrections, aimed), trajectory: null });
      }
    },
    onPointerCancel: () => setDraft(null),
    onPointerDownCapture: (event) => (pressed.current = [event.clientX, event.clientY]),
    onPointerEnter: preview.prepare,
    onPointerLeave: () => isSeeing && light(null),
    async onClick(event) {
      const [x, y] = pressed.current;
      if (!isSeeing || Math.hypot(event.clientX - x, event.clientY - y) > CLICK) return;
      const thing = await thingAt(pointIn(event.currentTarget, event), CLICK * unit);
      if (thing === undefined) return;
      if (thing) take(thing);
      const stays = thing ? tool === "mover" && get().lit?.others : tool !== "select";
      set({ tool: stays ? tool : thing ? "select" : "mover" });
    },
  };

  /** Whether a drag went far enough to mean something; else nothing is foreseen any more. */
  const isFar = (dx, dy) => {
    const far = Math.hypot(dx, dy) >= 2 * unit;
    if (!far) preview.end();
    return far;
  };
  const foresee = (aim) => {
    if (!simulation) return;
    if (player.playing) player.seek(0);
    preview.aim(aim);
  };
  const bodyOf = (place) => simulation?.trajectory.bodies.findIndex((body) => body.object === corrections.objects[place].object) ?? -1;

  const moverMoves = {
    onMove: (handle, dx, dy) => {
      setDraft({ mover: movedBox(corrections.grounding?.bbox ?? simulation.grounding.bbox, handle, dx, dy, size) });
    },
    onEnd: (handle, dx, dy) => {
      setDraft(null);
      if (!isFar(dx, dy)) return;
      const box = movedBox(corrections.grounding?.bbox ?? simulation.grounding.bbox, handle, dx, dy, size);
      correct(moverWith(simulation, corrections, { bbox: box }));
    },
  };

  const shownDirection = direction && origin ? direction : null;
  const aimedAt = (dx, dy) => {
    const [tx, ty] = tipOf(origin, known ?? [1, 0], size);
    return directionBetween(origin, [tx + dx, ty + dy]);
  };
  const pulled = (place, dx, dy) => pulledPath(base, frames, place, [dx, dy]);
  const ownObject = (place) => ({
    onMove: (handle, dx, dy) => {
      if (handle === "all" && bodyOf(place) > 0) foresee({ moved: { body: bodyOf(place), by: [dx, dy] } });
      setDraft({ object: place, box: movedBox(corrections.objects[place].bbox, handle, dx, dy, size) });
    },
    onEnd: (handle, dx, dy) => {
      setDraft(null);
      if (!isFar(dx, dy)) return;
      const moved = { ...corrections.objects[place], mask: null, bbox: movedBox(corrections.objects[place].bbox, handle, dx, dy, size) };
      correct({ objects: corrections.objects.map((object, index) => (index === place ? moved : object)) });
    },
  });

  return html`<section class="scene" aria-label="Picture">
    <${Tools} state=${state} layers=${layers} setLayers=${setLayers} hasFloor=${camera !== null} hasFutures=${(path?.futures ?? []).length > 0} isSeeing=${isSeeing} />
    <div class=${`frame tool-${tool}`} ref=${frame} style=${{ aspectRatio: `${size.width} / ${size.height}`, "--ratio": size.width / size.height }}>
      <img src=${picture.url} alt=${`The picture: ${picture.name}`} draggable=${false} />
      ${player.url && html`<video key=${player.url} ref=${player.element} src=${player.url} muted playsinline preload="auto" tabindex="-1" aria-label="The imagined clip"
        class=${(player.frame > 0 || player.playing) && !shown ? "" : "waiting"}></video>`}
      <svg ref=${svg} viewBox=${`0 0 ${size.width} ${size.height}`} role="group" aria-label="What was found" class=${shown && !draft?.points ? "aiming" : ""} ...${drawing}>
        ${!simulation && found.map((body, place) => html`<${Rect} key=${place} box=${body.bbox} kind="body" />`)}
        ${simulation && !shown && html`<${World} simulation=${simulation} unit=${unit} size=${size} layers=${layers} line=${points !== path.points ? lineOf({ points, visible: path.visible }) : null} />`}
        ${cutout && !draft?.mover && !player.playing && html`<image class="outline" href=${cutout.outline} x="0" y="0" width=${size.width} height=${size.height} />`}
        ${layers.floor && camera && html`<${Floor} camera=${camera} corrections=${corrections} size=${size} unit=${unit} isEditable=${editing} />`}
        ${isTakenShown && html`<${Lit} thing=${taken} size=${size} />`}
        ${lit?.things[0] && !draft && html`<${Lit} thing=${lit.things[0]} size=${size} />`}
        ${moverBox && html`<${Rect} box=${moverBox} kind=${cutout && !draft?.mover ? "mover thin" : "mover"} />`}
        ${corrections.objects.map((object, place) => {
          const box = draft?.object === place ? draft.box : object.bbox;
          return box && html`<${Rect} key=${`own ${place}`} box=${box} kind="own" />`;
        })}
        ${simulation && shown && html`<${Foreseen} shown=${shown} trajectory=${simulation.trajectory} />`}
        ${simulation && !shown && html`<${Moment} simulation=${simulation} frame=${player.frame} unit=${unit} layers=${layers} cutout=${cutout?.cutout} />`}
        ${layers.names && html`<${Labels} labels=${labels} unit=${unit} size=${size} />`}
        ${shownDirection && html`<${Arrow} from=${origin} direction=${shownDirection} size=${size} unit=${unit} />`}
        ${origin && !player.playing && html`<circle class="point" cx=${origin[0]} cy=${origin[1]} r=${3.5 * unit} />`}
        ${draft?.from && draft.tool === "direction" && draft.direction && !origin && html`<${Arrow} from=${draft.from} direction=${draft.direction} size=${size} unit=${unit} />`}
        ${draft?.from && draft.box && html`<${Rect} box=${draft.box} kind=${draft.tool === "mover" ? "mover" : "own"} />`}
        ${pending && html`<${Rect} box=${pending.bbox} kind="own" />`}
        ${editing && moverBox && (simulation || corrections.grounding?.bbox) && html`<${BoxHandles} box=${moverBox} unit=${unit} name=${moverName} kind="of-mover" covered=${covered(corrections.grounding?.bbox ?? simulation.grounding.bbox)} ...${moverMoves} />`}
        ${editing && corrections.objects.map((object, place) => object.bbox && html`<${BoxHandles} key=${`handles ${place}`} box=${draft?.object === place ? draft.box : object.bbox}
          unit=${unit} name=${object.object} kind="of-own" covered=${covered(object.bbox)} ...${ownObject(place)} />`)}
        ${editing && frames.map((at, place) => html`<${Handle} key=${`way ${place}`} at=${points[at]} unit=${unit} kind="waypoint" label=${`Point ${place + 1} of the path.`}
          onMove=${(dx, dy) => {
            foresee({ points: pulled(place, dx, dy) });
            setDraft({ points: pulled(place, dx, dy) });
          }}
          onEnd=${(dx, dy) => {
            setDraft(null);
            if (!isFar(dx, dy)) return;
            correct({
              ...knownBeside(simulation, corrections),
              grounding: corrections.grounding ?? groundingOf(simulation.grounding),
              trajectory: { points: pulled(place, dx, dy), fps: simulation.trajectory.fps },
            });
          }} />`)}
        ${tool === "select" && shownDirection && html`<${Handle} at=${tipOf(origin, shownDirection, size)} unit=${unit} kind="tip" label="Tip of the direction arrow."
          onMove=${(dx, dy) => {
            const aimed = aimedAt(dx, dy);
            if (aimed) foresee({ direction: aimed });
            setDraft({ direction: aimed });
          }}
          onEnd=${(dx, dy) => {
            const aimed = aimedAt(dx, dy);
            if (!aimed) preview.end();
            else if (isFar(dx, dy)) correct({ motion: motionTowards(simulation, corrections, aimed), trajectory: null });
            setDraft(null);
          }} />`}
      </svg>
      ${(shown || (simulation && draft && !draft.from && !preview.isLive)) && html`<${Foretold} shown=${shown} trajectory=${simulation.trajectory} />`}
    </div>
    ${layers.floor && camera && html`<${FloorLine} camera=${camera} corrections=${corrections} />`}
    ${pending && html`<${NameForm} onName=${(name) => {
      setPending(null);
      const object = { object: freeName(name, corrections.objects), bbox: pending.bbox, mask: pending.mask ?? null, role: roleOf(name, question) };
      correct({ objects: [...corrections.objects, object] });
    }} onCancel=${() => setPending(null)} />`}
    ${simulation ? html`<${Transport} player=${player} trajectory=${simulation.trajectory} />` : html`<div class="transport empty"></div>`}
    ${simulation && html`<${Filmstrip} simulation=${simulation} player=${player} />`}
  </section>`;
}

/** Asks for the name of an object that was drawn. */
function NameForm({ onName, onCancel }) {
  const field = useRef(null);
  useEffect(() => field.current.focus(), []);
  const submit = (event) => {
    event.preventDefault();
    const name = field.current.value.trim();
    if (name) onName(name);
  };
  return html`<form class="name-form" onSubmit=${submit}>
    <label>What is in the box? <input ref=${field} maxlength="200" required placeholder="such as wooden crate" dir="auto" autocomplete="off" /></label>
    <button class="primary">Add it</button>
    <button type="button" onClick=${onCancel}>Cancel</button>
  </form>`;
}
