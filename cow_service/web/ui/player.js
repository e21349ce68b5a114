// Plays a clip, or its path alone where there is no video: which frame is shown, and the controls.

import { html, useEffect, useRef, useState } from "../vendor/htm-preact.js";
import { useArtifact } from "../app/artifacts.js";
import { clamp } from "../app/geometry.js";
import { encounterWords, seconds } from "../app/words.js";

export const calm = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

/** The state of a player of a simulation: {frame, count, fps, playing, video, seek, toggle}. */
export function usePlayer(simulation, isBusy) {
  const [frame, setFrame] = useState(0);
  const [playing, setPlaying] = useState(false);
  const element = useRef(null);
  const moving = useRef(false); // a frame that was on its way when the film was stopped does not count
  const video = simulation?.video ?? null;
  const url = useArtifact(video?.sha256 ?? null);
  const count = simulation ? simulation.trajectory.paths[0].points.length : 0;
  const fps = video?.fps ?? simulation?.trajectory.fps ?? 1;

  useEffect(() => {
    setFrame(0);
    setPlaying(false);
  }, [simulation?.id]);

  // The film starts by itself once it can, unless reduced motion is set or a handle is held.
  useEffect(() => {
    if (simulation && !calm() && !isBusy() && (url || !video)) setPlaying(true);
  }, [simulation?.id, url]);

  useEffect(() => {
    if (!playing || !count) return undefined;
    moving.current = true;
    const film = element.current;
    let handle = 0;
    let wanted = true;
    const stop = () => {
      if (wanted) setPlaying(false);
    };
    if (film && url) {
      const show = (time) => setFrame(clamp(Math.floor(time * fps + 0.01), 0, count - 1));
      const shown = (_, meta) => {
        if (!wanted || !moving.current) return;
        show(meta.mediaTime);
        handle = film.requestVideoFrameCallback(shown);
      };
      handle = film.requestVideoFrameCallback(shown);
      film.addEventListener("ended", stop);
      film.play().catch(stop);
      return () => {
        wanted = false;
        film.cancelVideoFrameCallback(handle);
        film.removeEventListener("ended", stop);
        film.pause();
        show(film.currentTime); // it may have advanced since the last reported frame
      };
    }
    const began = performance.now() - (1000 * frame) / fps;
    const tick = (now) => {
      const next = Math.floor(((now - began) * fps) / 1000);
      setFrame(clamp(next, 0, count - 1));
      if (next >= count - 1) stop();
      else handle = requestAnimationFrame(tick);
    };
    handle = requestAnimationFrame(tick);
    return () => {
      wanted = false;
      cancelAnimationFrame(handle);
    };
  }, [playing, url, simulation?.id]);

  const seek = (wanted) => {
    const next = clamp(wanted, 0, count - 1);
    moving.current = false;
    setPlaying(false);
    setFrame(next);
    if (element.current) element.current.currentTime = (next + 0.5) / fps;
  };
  const toggle = () => {
    if (!playing && frame >= count - 1) {
      setFrame(0);
      if (element.current) element.current.currentTime = 0;
    }
    setPlaying(!playing);
  };
  return { frame, count, fps, playing, url, element, seek, toggle };
}

function marksOf(trajectory, fps) {
  const meets = trajectory.encounters.map((encounter) => ({
    frame: encounter.first_frame,
    time: encounter.time ?? encounter.first_frame / fps,
    kind: encounter.kind,
    text: encounterWords(encounter, trajectory),
  }));
  const floor = trajectory.contacts.filter((contact) => contact.b === null).map((contact) => ({
    frame: Math.round(contact.time * fps),
    time: contact.time,
    kind: "floor",
    text: `${trajectory.bodies[contact.a]?.object ?? "It"} meets the floor`,
  }));
  return [...meets, ...floor].sort((a, b) => a.frame - b.frame).slice(0, 40);
}

/** Play, a slider by frames, and when what happens. */
export function Transport({ player, trajectory }) {
  const { frame, count, fps, playing } = player;
  const last = Math.max(1, count - 1);
  const marks = marksOf(trajectory, fps);
  return html`<div class="transport" dir="ltr">
    <button class="round" onClick=${player.toggle} aria-label=${playing ? "Pause" : "Play"}>${playing ? "❚❚" : "▶"}</button>
    <div class="timeline">
      <div class="marks">
        ${marks.map((mark, place) => html`<button key=${place} class=${`mark ${mark.kind}`} style=${{ left: `${(100 * mark.frame) / last}%` }}
          title=${`${seconds(mark.time)}: ${mark.text}`} aria-label=${`Go to ${seconds(mark.time)}: ${mark.text}`}
          onClick=${() => player.seek(mark.frame)}></button>`)}
      </div>
      <input type="range" min="0" max=${last} value=${frame} aria-label="Frame of the clip"
        aria-valuetext=${`Frame ${frame} of ${last}, ${seconds(frame / fps)}`} onInput=${(event) => player.seek(Number(event.target.value))} />
    </div>
    <output class="time">${(frame / fps).toFixed(2)} s <small>frame ${frame}</small></output>
  </div>`;
}
