"""The output of `simulate`, `answer`, `models` and `doctor`: progress, results in a folder, tables."""

import hashlib
import platform
import shutil
import sys
from collections.abc import Sequence
from importlib.metadata import distributions
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ValidationError
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn
from rich.table import Table

from cow_service import __version__, records
from cow_service.cli.options import HINTS, read_file, writable
from cow_service.client import display
from cow_service.errors import CowError, InvalidRequest
from cow_service.requests import AnswerRequest, SimulateRequest, field_errors
from cow_service.requests.flat import REQUESTS
from cow_service.service import Service

if TYPE_CHECKING:
    from cow_service.readers.mllm.check import MllmCheck


def run_request(
    service: Service,
    kind: records.JobKind,
    image: Path,
    body: dict[str, Any],
    out: Path | None,
    formats: Sequence[str] = (),
    *,
    as_json: bool = False,
) -> records.Simulation | None:
    """Simulates or answers, shows the progress of each stage, prints a summary, and writes the results into a folder.

    Returns the simulation. `formats` are names of `video.FORMATS`. Raises `InvalidRequest`, which names the wrong
    fields, or says that a format needs the video.
    """
    if formats and not body.get("video", True):
        raise InvalidRequest("--format converts the video: leave --no-video out.")
    # Silent with JSON: standard output is for a program.
    console = Console(stderr=as_json, quiet=as_json, highlight=False, soft_wrap=True)
    if out is not None:
        with writable(out):  # before the work, so that its results are not lost
            out.mkdir(parents=True, exist_ok=True)
    request = _checked(kind, {"image": {"artifact": service.keep_image(read_file(image)).sha256}, **body})
    result: records.Simulation | records.Answer
    with Progress(TextColumn("{task.description:<10}"), BarColumn(24), console=console, transient=True) as bars:
        bar = bars.add_task("loading", total=1.0)  # loading a model takes a while before the first stage

        def show(stage: records.Stage | None, done: float) -> None:
            bars.update(bar, description=stage, completed=stage and records.share_done(kind, stage, done))

        is_answer = isinstance(request, AnswerRequest)
        result = service.answer(request, show) if is_answer else service.simulate(request, show)
    written = [] if out is None else save(service, result, out, formats)
    if as_json:
        print(result.model_dump_json(indent=2))
    _print_result(console, result)
    if written:
        console.print(f"Wrote to [bold]{escape(str(out))}[/]: {', '.join(written)}")
    return result.simulation if isinstance(result, records.Answer) else result


def _print_result(console: Console, result: records.Simulation | records.Answer) -> None:
    is_answer = isinstance(result, records.Answer)
    simulation, problem = (result.simulation, result.simulation_problem) if is_answer else (result, None)
    if simulation is not None:
        print_stages(console, simulation)
    if isinstance(result, records.Answer):
        console.print(answer_table(result))
        if result.reasoning:
            console.print(f"[dim]reasoning[/]: {escape(result.reasoning)}")
    elif result.narration.answer:
        console.print(f"[bold]{escape(result.narration.summary)}[/]")
    hint = None if problem is None else HINTS.get(problem.code)
    for warning in result.warnings:
        told = warning.replace(problem.remedy, hint) if problem and problem.remedy and hint else warning
        console.print(f"[yellow]warning[/]: {escape(told)}")


def _checked(kind: records.JobKind, body: dict[str, Any]) -> SimulateRequest:
    model = REQUESTS[kind]
    try:
        return model.model_validate(body)
    except ValidationError as error:
        fields, known = field_errors(error.errors()), ", ".join([*model.model_fields][2:])
        faults = "; ".join(f"{field.pointer[1:].replace('/', '.') or 'request'}: {field.detail}" for field in fields)
        remedy = f"--request takes these fields: {known}. The page /docs of a server describes them."
        raise InvalidRequest(f"{faults}.", errors=fields, remedy=remedy * ("no such field" in faults)) from error


def print_stages(console: Console, simulation: records.Simulation) -> None:
    """Prints a line for each stage: its time and its result; then the contacts and what happens."""
    grounding, motion, trajectory = simulation.grounding, simulation.motion, simulation.trajectory
    x, y = grounding.point
    way = "" if motion.direction is None else f" ({motion.direction[0]:+.2f}, {motion.direction[1]:+.2f})"
    if motion.depth:
        way += " and towards the camera" if motion.depth < 0 else " and away from the camera"
    speed = f", {motion.speed:.0f} px/s" if motion.kind in records.DIRECTED_KINDS else ""
    video = f", {simulation.video.num_frames}-frame video" if simulation.video else ""
    lines = {
        "grounding": f"{grounding.object} at ({x:.0f}, {y:.0f}), from {grounding.source}",
        "motion": f"{motion.kind}{way}{speed}, from {motion.cue}",
        "trajectory": f"{display.encounters_words(trajectory)}, law {trajectory.law}",
        "generation": f"{len(simulation.frames)} frames{video}, by {simulation.generator.name}",
    }
    for stage, line in lines.items():
        console.print(f"[bold]{stage:<10}[/] {simulation.timings[stage]:5.2f} s  {escape(line)}")
    if contacts := display.contacts_words(trajectory):
        console.print(f"[dim]contacts[/]: {escape(contacts)}")
    console.print(f"[dim]story[/]: {escape(simulation.narration.story)}")


def _result_in(folder: Path) -> records.Simulation | None:
    try:
        return records.Simulation.model_validate_json((folder / "simulation.json").read_bytes())
    except (OSError, ValueError):
        return None


def default_folder(image: Path) -> Path:
    """`<name of the image>-cow`, with a number if that folder holds the result of another picture."""
    folder, number, sha256 = Path(f"{image.stem}-cow"), 1, hashlib.sha256(read_file(image)).hexdigest()
    while (found := _result_in(folder)) is not None and found.image.sha256 != sha256:
        number += 1
        folder = Path(f"{image.stem}-cow-{number}")
    return folder


def save(service: Service, result: records.Simulation | records.Answer, out: Path, formats: Sequence[str]) -> list[str]:
    """Writes frames, video, overlay, the result as JSON and the clip in other formats; returns the names of files."""
    artifacts, documents, made = records.artifacts_of(result), records.documents_of(result), dict[str, Any]()
    stale = ("simulation.json", "answer.json", "clip.gif", "clip.webp", "sheet.png")  # of an earlier run
    with writable(out):
        for name in () if (earlier := _result_in(out)) is None else (*records.artifacts_of(earlier), *stale):
            (out / name).unlink(missing_ok=True)
        for name, sha256 in artifacts.items():
            (out / name).write_bytes(service.artifacts.read(sha256))
        for name, text in documents.items():
            (out / name).write_text(text, encoding="utf-8")
        if formats:
            from cow_service.media import video  # noqa: PLC0415 # FFmpeg's bindings take long to import

            frames, fps = video.frames_of((out / records.VIDEO_FILE).read_bytes())
            made = dict(video.FORMATS[each] for each in formats)
            for name, make in made.items():
                (out / name).write_bytes(make(frames, fps))
    return [*artifacts, *documents, *made]


def print_models(models: records.Models, *, as_json: bool) -> None:
    """Prints a table of backends, or their JSON."""
    if as_json:
        print(models.model_dump_json(indent=2))
        return
    table = Table("role", "name", "ready", "what it is", box=None, pad_edge=False)
    for backend in (*models.readers, *models.generators, *models.perception):
        name = backend.name + (" (default)" if backend.default else "")
        table.add_row(backend.kind or "", name, _readiness(backend), backend.summary)
    console = Console()
    console.print(table)
    console.print(f"\nValues of COW_MLLM: provider:model, or one of: {', '.join(models.mllms)}", highlight=False)
    if models.mllm is not None:
        console.print(escape(_mllm_words(models.mllm)), highlight=False, soft_wrap=True)


def _mllm_words(mllm: records.MllmStatus) -> str:
    takes = "nothing is known of its server" if mllm.takes is None else f"its server takes {_taken(mllm.takes)}"
    exact = "not checked (`cow models check --save`)" if mllm.measured is None else _spreads(mllm.measured)
    return f"COW_MLLM: {mllm.name} (family {mllm.family}); {takes}; {exact}"


def _taken(takes: records.ServerCapabilities) -> str:
    """What a server takes of a call, in words."""
    refused = [name.replace("_", " ") for name in ("temperature", "seed", "system_role") if not getattr(takes, name)]
    return ", ".join((
        f"{takes.output}, {takes.token_field}",
        *(f"no {name}" for name in refused),
        *(() if takes.images is None else (f"{takes.images} image{'s' * (takes.images > 1)} a call",)),
        *(("smaller images",) if takes.reduction else ()),
        *(() if takes.delivery == "whole" else ("`stream: true`",)),
    ))  # fmt: skip


def _spreads(measured: records.MllmMeasurement) -> str:
    """How exact readings count as being."""
    spreads = f"boxes count as exact to {measured.bbox_deviation:.0%} of a side, directions to "
    spreads += f"{measured.direction_deviation:.0f} degrees"
    return spreads if measured.coordinates is None else f"{spreads}; places are {measured.coordinates.words}"


def print_check(check: "MllmCheck", mllm: records.MllmStatus | None, *, is_kept: bool) -> None:
    """How a multimodal LLM answered the questions of a check, and what is known of it now."""
    console = Console(highlight=False, soft_wrap=True)
    table = Table("asked for", "", "", box=None, pad_edge=False)
    for finding in check.findings:
        mark = "[green]good[/]" if finding.usable else "[yellow]not good[/]"
        table.add_row(finding.question, mark, escape(finding.result))
    console.print(table)
    console.print(f"{check.usage.calls} calls; the longest question took {check.seconds:.1f} s.")
    if mllm is not None and mllm.takes is not None:
        console.print(f"Its server takes {_taken(mllm.takes)}.")
    if check.measured is None:
        console.print("Nothing was measured: most boxes were not found, or no direction was given.")
    elif is_kept:
        console.print(f"Kept: {_spreads(check.measured)}. A running COW goes by it once it is started again.")
    else:
        console.print(f"Not kept (--save does that): {_spreads(check.measured)}.")


def _readiness(backend: records.BackendInfo) -> str:
    words = escape(display.readiness_words(backend))
    return words if backend.ready is None else f"[{'green' if backend.ready else 'yellow'}]{words}[/]"


def answer_table(answer: records.Answer) -> Table:
    """The answer, its votes, and what it cost."""
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(style="bold")
    table.add_column()
    colour = "yellow" if answer.not_sure or answer.answer is None else "green"
    table.add_row("answer", f"[{colour}]{escape(display.describe_answer(answer))}[/]")
    for name, said in display.answer_facts(answer).items():
        table.add_row(name, escape(said))
    table.add_row("tokens", display.asked_words(answer.usage, answer.usage_total))
    table.add_row("time", f"{sum(answer.timings.values()):.2f} s")
    model = answer.reader.model
    table.add_row("reader", escape(answer.reader.name if model is None else f"{answer.reader.name} ({model})"))
    return table


# `cow doctor`

PACKAGES = (
    "fastapi", "uvicorn", "pydantic", "numpy", "opencv-python-headless", "pillow", "av", "torch", "diffusers",
    "transformers", "pydantic-ai-slim", "llguidance",
)  # fmt: skip


class Report(BaseModel):
    """What `cow doctor` found."""

    cow: str
    python: str
    platform: str
    packages: dict[str, str | None]
    data_folder: str
    free_disk_gb: float
    problem: str | None
    backends: list[records.BackendInfo]
    mllm: records.MllmStatus | None


def examine(service: Service) -> Report:
    """Inspects this installation.

    Imports no model library, and writes only an empty file, which it removes.
    """
    problem = None
    try:
        service.check()
    except CowError as error:
        problem = f"{error.code}: {error.detail}"
    models = service.models()
    installed = {distribution.name.lower(): distribution.version for distribution in distributions()}
    folder = service.settings.data_dir
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return Report(
        cow=__version__,
        python=platform.python_version(),
        platform=f"{sys.platform} {platform.machine()}",
        packages={name: installed.get(name) for name in PACKAGES},
        data_folder=str(service.settings.data_dir),
        free_disk_gb=round(shutil.disk_usage(folder).free / 1e9, 1),
        problem=problem,
        backends=[*models.readers, *models.generators, *models.perception],
        mllm=models.mllm,
    )


def print_report(report: Report, *, as_json: bool) -> None:
    """The report as a table, or as JSON."""
    if as_json:
        print(report.model_dump_json(indent=2))
        return
    console = Console()
    console.print(f"cow {report.cow}, Python {report.python}, {report.platform}", highlight=False)
    folder = f"data folder: {report.data_folder} ({report.free_disk_gb:.1f} GB free)"
    console.print(folder, highlight=False, soft_wrap=True)
    table = Table("backend", "ready", "get it with", box=None, pad_edge=False)
    for backend in report.backends:
        table.add_row(backend.name, _readiness(backend), escape(backend.install or backend.pull or "-"))
    console.print(table)
    installed = ", ".join(f"{name} {found}" for name, found in report.packages.items() if found)
    console.print(f"installed: {installed}", highlight=False)
    if report.mllm is not None:
        console.print(escape(_mllm_words(report.mllm)), highlight=False, soft_wrap=True)
    if report.problem:
        console.print(f"[red]{report.problem}[/]", highlight=False)
    else:
        console.print("[green]Everything that a default request needs is ready.[/]")
