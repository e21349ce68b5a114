"""What the command line does and shows: requests from options, results into a folder, tables."""

from __future__ import annotations

import json
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar, cast

from pydantic import ValidationError
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.table import Table

from cow_service.errors import CowError, InvalidRequest
from cow_service.media.images import DecodedImage
from cow_service.records import BackendInfo, Models, Simulation
from cow_service.requests import SimulateRequest, Stage
from cow_service.service import Service

Body = TypeVar("Body", bound=SimulateRequest)


def build_request(
    *,
    point: str | None,
    box: str | None,
    name: str | None,
    direction: str | None,
    kind: str,
    speed: float | None,
    trajectory: Path | None,
    option: list[str],
    **rest: Any,
) -> dict[str, Any]:
    """The request's body without its image. Raises `InvalidRequest` naming the option that cannot be read."""
    body = {**rest, "generator_options": dict(map(_option, option))}
    if point is not None or box is not None:
        body["grounding"] = {
            "object": name,
            "point": None if point is None else _numbers("--point", point, 2),
            "bbox": None if box is None else _numbers("--box", box, 4),
        }
    elif name is not None and trajectory is None:
        raise InvalidRequest("--object goes with --point, --box or --trajectory; else the question names the object.")
    if direction is not None or kind in ("fall", "static"):
        body["motion"] = {
            "direction": None if direction is None else _numbers("--direction", direction, 2),
            "kind": kind,
            "speed": speed,
        }
    elif kind != "linear" or speed is not None:
        raise InvalidRequest("--kind and --speed go with --direction; without it the motion is read from the question.")
    if trajectory is not None:
        body["trajectory"] = path = _json(trajectory)
        if name is not None and "grounding" not in body and isinstance(path, dict):
            body["grounding"] = {
                "object": name,
                "point": next(iter(cast("dict[str, Any]", path).get("points", [])), None),
            }
    return body


def run_simulation(service: Service, image: Path, body: dict[str, Any], out: Path, *, as_json: bool) -> None:
    """Simulates, showing each stage as it runs, writes the results into a folder, and says what came out."""
    console = console_for(as_json)
    make_folder(out)
    request, decoded = read_request(service, image, body, SimulateRequest)
    with stages_shown(console) as show:
        simulation = service.simulate(request, show, decoded)
    written = save(service, simulation, out)
    if as_json:
        print(simulation.model_dump_json(indent=2))
        return
    tell(console, simulation)
    tell_warnings(console, simulation.warnings)
    console.print(f"Wrote to [bold]{escape(str(out))}[/]: {', '.join(written)}")


def console_for(as_json: bool) -> Console:
    """Where people read; silent where a program does."""
    return Console(stderr=as_json, quiet=as_json, highlight=False, soft_wrap=True)


def read_request(service: Service, image: Path, body: dict[str, Any], model: type[Body]) -> tuple[Body, DecodedImage]:
    """The checked request and its image, which the service keeps. Raises `InvalidRequest` naming the fields."""
    artifact, decoded = service.keep_image(_read(image))
    try:
        return model.model_validate({"image": {"artifact": artifact.sha256}, **body}), decoded
    except ValidationError as error:
        told = "; ".join(f"{'.'.join(map(str, item['loc'])) or 'request'}: {item['msg']}" for item in error.errors())
        raise InvalidRequest(told) from error


@contextmanager
def stages_shown(console: Console) -> Generator[Callable[[Stage | None, float], None]]:
    """Bars for the stages, as they run."""
    columns = TextColumn("{task.description:<10}"), BarColumn(bar_width=24)
    with Progress(*columns, console=console, transient=True) as bars:
        tasks: dict[Stage, TaskID] = {}
        loading = bars.add_task("loading", total=None)  # a model takes its time before the first stage

        def show(stage: Stage | None, done: float) -> None:
            if stage is None:
                return
            bars.update(loading, visible=False)
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=1.0)
            bars.update(tasks[stage], completed=done)

        yield show


def tell(console: Console, simulation: Simulation) -> None:
    """A line for each stage of what came out of it."""
    for stage, said in _told(simulation).items():
        console.print(f"[bold]{stage:<10}[/] {simulation.timings[stage]:5.2f} s  {escape(said)}")


def tell_warnings(console: Console, warnings: Iterable[str]) -> None:
    """A line for each."""
    for warning in warnings:
        console.print(f"[yellow]warning[/]: {escape(warning)}")


def make_folder(out: Path) -> None:
    """Before any work is done, so that it is not lost."""
    with writable(out):
        out.mkdir(parents=True, exist_ok=True)


def save(service: Service, simulation: Simulation, out: Path) -> list[str]:
    """Writes frames, video, overlay and simulation.json into a folder; returns their names."""
    files = {f"frame_{frame.index:03d}.png": frame.sha256 for frame in simulation.frames}
    files["overlay.png"] = simulation.overlay.sha256
    if simulation.video is not None:
        files["video.mp4"] = simulation.video.sha256
    with writable(out):
        for name, sha256 in files.items():
            (out / name).write_bytes(service.artifacts.read(sha256))
        (out / "simulation.json").write_text(simulation.model_dump_json(indent=2) + "\n", encoding="utf-8")
    return [*files, "simulation.json"]


@contextmanager
def writable(out: Path) -> Generator[None]:
    """Says which folder could not be written, where one could not."""
    try:
        yield
    except OSError as error:
        raise CowError(f"'{out}' cannot be written: {error.strerror}. Choose another folder with --out.") from error


def print_models(models: Models, *, as_json: bool) -> None:
    """A table of backends, or their JSON."""
    if as_json:
        print(models.model_dump_json(indent=2))
        return
    table = Table(box=None, pad_edge=False)
    for heading in ("door", "name", "ready", "what it is"):
        table.add_column(heading)
    for door, backends in (("reader", models.readers), ("generator", models.generators)):
        for backend in backends:
            table.add_row(
                door, backend.name + (" (default)" if backend.default else ""), _readiness(backend), backend.summary
            )
    console = Console()
    console.print(table)
    console.print(f"\nCOW_MLLM takes one of these, or provider:model: {', '.join(models.mllms)}", highlight=False)


def _readiness(backend: BackendInfo) -> str:
    if backend.ready is None:
        return "unknown"
    if backend.ready:
        return "[green]yes[/]"
    return f"[yellow]needs {', '.join(backend.missing) or 'its weights'}[/]"


def _told(simulation: Simulation) -> dict[Stage, str]:
    """One line per stage of what came out of it."""
    grounding, motion, trajectory = simulation.grounding, simulation.motion, simulation.trajectory
    x, y = grounding.point
    way = "" if motion.direction is None else f" ({motion.direction[0]:+.2f}, {motion.direction[1]:+.2f})"
    if motion.depth:
        way += " and towards the camera" if motion.depth < 0 else " and away from the camera"
    met = ", ".join(f"{e.kind} {e.object} at {e.first_frame / trajectory.fps:.1f} s" for e in trajectory.encounters)
    video = f", {simulation.video.num_frames}-frame video" if simulation.video else ""
    return {
        "grounding": f"{grounding.object} at ({x:.0f}, {y:.0f}), from {grounding.source}",
        "motion": f"{motion.kind}{way}, {motion.speed:.0f} px/s, from {motion.cue}",
        "trajectory": met or ("meets nothing" if simulation.encounters_known else "encounters were not computed"),
        "generation": f"{len(simulation.frames)} frames{video}, by {simulation.generator.name}",
    }


def _numbers(option: str, text: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.replace(" ", "").split(",")]
    except ValueError:
        values = []
    if len(values) != count:
        raise InvalidRequest(
            f"{option} takes {count} numbers with commas between, such as {','.join(['10'] * count)}; got '{text}'."
        )
    return values


def _option(given: str) -> tuple[str, object]:
    """Name and value; what is no JSON is text."""
    name, equals, text = given.partition("=")
    if not name or not equals:
        raise InvalidRequest(f"--option takes NAME=VALUE, such as steps=20; got '{given}'.")
    try:
        return name, json.loads(text)
    except ValueError:
        return name, text


def _json(path: Path) -> object:
    try:
        return json.loads(_read(path))
    except ValueError as error:
        raise InvalidRequest(f"{path.name} is not JSON: {error}.") from error


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise CowError(f"'{path}' cannot be read: {error.strerror}.") from error
