"""The command line. Heavy imports stand inside the commands, so that `cow --help` is quick."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from cow_service import __version__
from cow_service.cli import batch as batch_cli
from cow_service.cli import eval as eval_cli
from cow_service.cli import keys as keys_cli
from cow_service.cli import mcp as mcp_cli
from cow_service.cli import models as models_cli
from cow_service.cli import options
from cow_service.cli import top as top_cli
from cow_service.cli import tracks as tracks_cli
from cow_service.cli.errors import Commands
from cow_service.cli.options import with_request_options
from cow_service.cli.starting import quick_imports

# Log levels of libraries that print notes when they are imported, such as on optional packages.
QUIET = {"TRANSFORMERS_VERBOSITY": "error", "DIFFUSERS_VERBOSITY": "error"}

if TYPE_CHECKING:
    from cow_service.service import Service

app = typer.Typer(
    cls=Commands,
    rich_markup_mode=None,  # plain help: rich takes twice as long to import as everything else
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Look before you answer: imagine the future of an image.",
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"cow {__version__}")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Look before you answer: imagine the future of an image."""


@app.command()
@with_request_options
def simulate(
    image: options.Image,
    question: options.Question,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for the results.", show_default="./<image>-cow")
    ] = None,
    video: Annotated[bool, typer.Option(help="Make the mp4.")] = True,
    formats: Annotated[
        list[options.Format] | None,
        typer.Option("--format", help="Also an animated gif or webp, or a contact sheet; may be repeated."),
    ] = None,
    open_it: Annotated[bool, typer.Option("--open", help="Open the video, or the overlay, when it is done.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the simulation as JSON, and nothing else.")] = False,
    *,
    request: dict[str, Any],
) -> None:
    """Imagine an image's future: frames, video and overlay.

    They go into a folder, with simulation.json.
    """
    from cow_service.cli.console import run_simulation  # noqa: PLC0415

    body = {**request, "question": question, "video": video}
    out = out or Path(f"{image.stem}-cow")
    with _service() as service:
        simulation = run_simulation(service, image, body, out, tuple(formats or ()), as_json=as_json)
    if open_it:
        typer.launch(str(out / ("video.mp4" if video else simulation.overlay_name)))


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")] = Path("cow-demo"),
    open_it: Annotated[bool, typer.Option("--open", help="Open the video when it is done.")] = False,
) -> None:
    """Imagine the future of an example: a ball is pushed towards a mug."""
    from cow_service.cli.console import run_simulation  # noqa: PLC0415
    from cow_service.cli.demo import QUESTION, example_image  # noqa: PLC0415

    with _service() as service, example_image() as image:
        run_simulation(service, image, {"question": QUESTION, "frames": {"policy": "events"}}, out, as_json=False)
    if open_it:
        typer.launch(str(out / "video.mp4"))


@app.command()
@with_request_options
def answer(
    image: options.Image,
    question: options.Question,
    choice: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TEXT",
            help="An answer to choose from, in order A, B, C...; may be repeated.",
            show_default="those in the question",
        ),
    ] = None,
    imagine: Annotated[
        Literal["always", "auto", "never"],
        typer.Option(help="Simulate first; auto: only where answers from the image alone disagree or are not sure."),
    ] = "always",
    no_imagine: Annotated[bool, typer.Option("--no-imagine", help="The same as --imagine never.")] = False,
    imagine_votes: Annotated[int, typer.Option(help="Of --imagine auto: votes before anything is imagined.")] = 3,
    imagine_threshold: Annotated[
        float, typer.Option(help="Of --imagine auto: share of them that agrees, for nothing to be imagined.")
    ] = 1.0,
    votes: Annotated[int, typer.Option(help="How often to ask; the most frequent answer is taken.")] = 1,
    baseline: Annotated[bool, typer.Option("--baseline", help="Answer without frames, too, for comparison.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for the simulation and answer.json.", show_default="none")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the answer as JSON, and nothing else.")] = False,
    *,
    request: dict[str, Any],
) -> None:
    """Answer a question after looking at the imagined future.

    Shows the answer, the votes, the baseline, tokens and time.
    """
    from cow_service.cli.console import run_answer  # noqa: PLC0415

    body = {
        **request,
        "question": question,
        "options": choice,
        "imagine": "never" if no_imagine else imagine,
        "imagine_votes": imagine_votes,
        "imagine_threshold": imagine_threshold,
        "votes": votes,
        "baseline": baseline,
        "video": out is not None,
    }
    with _service() as service:
        run_answer(service, image, body, out, as_json=as_json)


@app.command()
def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on.", show_default="COW_HOST, 127.0.0.1")] = None,
    port: Annotated[
        int | None, typer.Option(help="Port to listen on; 0 takes a free one.", show_default="COW_PORT, 8000")
    ] = None,
    role: Annotated[
        Literal["all", "api"] | None,
        typer.Option(help="api: take requests only, and leave the jobs to `cow worker`.", show_default="COW_ROLE, all"),
    ] = None,
) -> None:
    """Start the server."""
    with quick_imports():
        service = _served(host=host, port=port, role=role)
        from cow_service.cli.ports import check_port  # noqa: PLC0415

        check_port(service.settings)
        from cow_service.workers.pool import WorkerPool  # noqa: PLC0415

        settings = service.settings
        pool = WorkerPool(settings, service.metrics) if settings.workers and settings.role == "all" else None
        if pool is not None:
            pool.start()  # its processes start while the server is imported
        from cow_service.api.app import warn_if_open  # noqa: PLC0415
        from cow_service.server import run_server  # noqa: PLC0415

    warn_if_open(settings)
    run_server(service, pool)


@app.command()
def worker(
    queues: Annotated[
        str | None,
        typer.Option(help="Queues to take jobs from: light, and ati or another name.", show_default="COW_QUEUES, all"),
    ] = None,
) -> None:
    """Compute the jobs of servers on the same job database."""
    named = None if queues is None else tuple(name.strip() for name in queues.split(",") if name.strip())
    with quick_imports():
        service = _served(queues=named)
        from cow_service.workers.pool import WorkerPool  # noqa: PLC0415

        pool = WorkerPool(service.settings, service.metrics)
        pool.start()
        from cow_service.server import run_worker  # noqa: PLC0415

    run_worker(service, pool)


def _served(**overrides: Any) -> Service:
    """The service of a process that goes on, with its logs and traces."""
    service = _service(ahead=True, **overrides)
    from cow_service.jobs.queues import check_queues  # noqa: PLC0415
    from cow_service.observability import logging as logs  # noqa: PLC0415
    from cow_service.observability import tracing  # noqa: PLC0415

    check_queues(service.settings)
    logs.set_up(service.settings)
    tracing.start()
    return service


@app.command()
def migrate() -> None:
    """Create or update the tables of the job database.

    Servers and workers do so themselves when they start, unless COW_MIGRATE is false.
    """
    from cow_service.jobs.migration import migrate as run  # noqa: PLC0415
    from cow_service.settings import load_settings  # noqa: PLC0415

    run(load_settings())
    typer.echo("The job database is up to date.")


@app.command()
def doctor(as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False) -> None:
    """Show what is installed, and what each backend lacks.

    Names the command that installs it.
    """
    from cow_service.cli.doctor import examine, print_report  # noqa: PLC0415

    with _service() as service:
        report = examine(service)
    print_report(report, as_json=as_json)
    if not report.healthy:
        raise typer.Exit(1)


@app.command(hidden=True)
def openapi() -> None:
    """Print the HTTP contract as YAML; `make openapi` keeps openapi.yaml with it."""
    import yaml  # noqa: PLC0415

    from cow_service.api.app import create_app  # noqa: PLC0415
    from cow_service.jobs.engine import JobEngine  # noqa: PLC0415

    document = create_app(JobEngine(_service())).openapi()
    typer.echo(yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=120), nl=False)


def _service(*, ahead: bool = False, **overrides: Any) -> Service:
    """`ahead`: its first worker process, where there will be one, is started before all that it needs is imported."""
    from cow_service.settings import load_settings  # noqa: PLC0415

    for name, level in QUIET.items():
        os.environ.setdefault(name, level)
    settings = load_settings(**overrides)
    if ahead and settings.workers and settings.role == "all":
        from cow_service.workers.spawning import spawn_ahead  # noqa: PLC0415

        spawn_ahead()
    from cow_service.service import Service  # noqa: PLC0415

    return Service(settings)


app.command("batch")(batch_cli.batch)
app.command("mcp")(mcp_cli.mcp)
app.command("top")(top_cli.top)
app.add_typer(eval_cli.app, name="eval")
app.add_typer(keys_cli.app, name="keys")
app.add_typer(models_cli.app, name="models")
app.add_typer(tracks_cli.app, name="tracks")

if __name__ == "__main__":
    sys.exit(app())
