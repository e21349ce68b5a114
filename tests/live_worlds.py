"""The page's physics run in a browser: for its tests and its benchmark."""

from __future__ import annotations

from typing import Any

LOAD = """async (address) => {
    const { loadEngine } = await import("/web/live/preview.js");
    window.R = await loadEngine(() => import("/web/vendor/rapier.js"), () => fetch("/web/vendor/rapier.wasm"));
    window.live = await import("/web/live/world.js");
}"""
RUN = """({ world, direction = null, along = null }) => {
    const { bodiesOf, cameraOf, countOf, meetingsOf, positionsAlong, runWorlds, sharesOf, verdictOf } = window.live;
    const begin = Array.from({ length: countOf(world) }, (_, k) => bodiesOf(world, k, { direction }));
    const { fps, num_frames: frames, constants: c, horizon } = world;
    const began = performance.now();
    const [run] = runWorlds(window.R, c, [begin[0]], {
        fps, frames, isAlone: true, along: along && [positionsAlong(world, 0, along)] });
    const likeliest = performance.now();
    const timing = { fps: c.clock, every: c.every };
    const runs = runWorlds(window.R, c, begin.slice(1), { ...timing, frames: Math.ceil(horizon * c.clock) + 1 });
    const ended = performance.now();
    const points = run.positions[0].map((position) => cameraOf(world, 0).project(position));
    const verdicts = runs.map((run, place) => verdictOf(world, run, place + 1, timing));
    return { velocities: begin.map(([mover]) => mover.velocity), points, met: meetingsOf(world, run)[0] ?? null,
        moved: [...run.moved], shares: sharesOf(world, verdicts),
        milliseconds: [likeliest - began, ended - likeliest] };
}"""
KEPT = ("kind", "law", "speed", "speed_deviation", "depth", "depth_deviation", "rises", "distance", "duration", "until")


def given_again(motion: dict[str, Any], direction: list[float]) -> dict[str, Any]:
    """A result's motion with another direction, as the page asks for it."""
    kept = {name: motion[name] for name in KEPT if motion[name] not in (None, 0, False)}
    if abs(motion["depth"]) > 0.95:
        del kept["depth"]
    steps = [{name: value for name, value in step.items() if value is not None} for step in motion["steps"]]
    return kept | {"direction": direction} | ({"steps": steps} if steps else {})
