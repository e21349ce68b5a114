"""The command line. Heavy imports are inside the commands, so that `cow --help` is quick."""

import sys
from importlib.resources import as_file
from pathlib import Path
from typing import Annotated

import typer

from cow_service import __version__
from cow_service.cli import batch, eval, models, options, server
from cow_service.cli.options import AsJson, Asking, Commands, option

app = typer.Typer(
    cls=Commands,
    rich_markup_mode=None,  # plain help: rich takes twice as long to import as everything else
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Look before you answer: imagine the future of an image.",
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"cow {__version__}")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[bool, option("Show the version.", "--version", callback=_version, is_eager=True)] = False,
) -> None:
    """Look before you answer: imagine the future of an image."""


@app.command(cls=Asking, epilog='Example: cow simulate photo.jpg "If the ball falls, what does it hit?"')
def simulate(
    request: typer.Context,
    image: options.Image,
    question: options.Question,
    out: Annotated[Path | None, option("Folder for results.", "--out", "-o", shown="./<image>-cow, or -cow-2")] = None,
    formats: Annotated[
        list[options.Format] | None,
        option("Also make an animated gif or webp, or a contact sheet; may be repeated.", "--format"),
    ] = None,
    open_it: Annotated[bool, option("Open the video (or the overlay, without one) at the end.", "--open")] = False,
    as_json: Annotated[bool, option("Print the simulation as JSON, and nothing else.", "--json")] = False,
) -> None:
    """Imagine an image's future: frames, video and overlay.

    Writes them into a folder, together with simulation.json.
    """
    from cow_service.cli.console import default_folder, run_request  # noqa: PLC0415

    body = {**request.obj, "question": question}
    out = out or default_folder(image)
    with server.open_service() as service:
        simulation = run_request(service, "simulate", image, body, out, formats or (), as_json=as_json)
    if open_it and simulation is not None:
        typer.launch(str(out / ("video.mp4" if simulation.video else simulation.overlay_name)))


@app.command(epilog="Example: cow demo --open")
def demo(
    out: Annotated[Path, option("Folder for the results.", "--out", "-o")] = Path("cow-demo"),
    open_it: Annotated[bool, option("Open the video when it is done.", "--open")] = False,
) -> None:
    """Run a built-in example: a ball moves towards a mug."""
    from cow_service.cli.console import run_request  # noqa: PLC0415
    from cow_service.weights.manifests import EXAMPLES  # noqa: PLC0415

    question = "If the yellow ball moves opposite to the direction of the arrow, will it hit the blue mug?"
    with server.open_service() as service, as_file(EXAMPLES["ball-and-mug"].file("image")) as image:
        run_request(service, "simulate", image, {"question": question}, out)
    if open_it:
        typer.launch(str(out / "video.mp4"))


@app.command(cls=Asking, epilog='Example: cow answer photo.jpg "If the red ball moves left, will it hit the vase?"')
def answer(
    request: typer.Context,
    image: options.Image,
    question: options.Question,
    no_imagine: Annotated[bool, option("The same as --imagine never.", "--no-imagine")] = False,
    out: Annotated[Path | None, option("Folder for simulation and answer.json.", "--out", "-o", shown="none")] = None,
    as_json: Annotated[bool, option("Print the answer as JSON, and nothing else.", "--json")] = False,
) -> None:
    """Answer a question after looking at the imagined future.

    Prints the answer, the votes, the answer without frames, tokens and time.
    """
    from cow_service.cli.console import run_request  # noqa: PLC0415

    never = {"imagine": "never"} if no_imagine else {}
    body = {**request.obj, **never, "question": question, "video": out is not None}
    with server.open_service() as service:
        run_request(service, "answer", image, body, out, as_json=as_json)


@app.command(epilog="Example: cow doctor")
def doctor(as_json: AsJson = False) -> None:
    """Show what is installed, and what each backend lacks.

    Prints the command that installs what is missing. Exit code 1 if the default request cannot be served.
    """
    from cow_service.cli.console import examine, print_report  # noqa: PLC0415

    with server.open_service() as service:
        report = examine(service)
    print_report(report, as_json=as_json)
    if report.problem is not None:
        raise typer.Exit(1)


@app.command(hidden=True)
def openapi() -> None:
    """Print the HTTP contract as YAML; `make openapi` writes it to openapi.yaml."""
    import yaml  # noqa: PLC0415

    from cow_service.api.app import create_app  # noqa: PLC0415
    from cow_service.jobs.engine import JobEngine  # noqa: PLC0415

    document = create_app(JobEngine(server.open_service())).openapi()
    typer.echo(yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=120), nl=False)


for command, example in {
    server.serve: "cow serve --port 8000",
    server.worker: "cow worker",
    server.migrate: "cow migrate",
    server.mcp: "cow mcp --transport http",
    batch.batch: "cow batch questions.jsonl --out results",
    models.tracks: "cow tracks photo-cow/simulation.json --out tracks.npy",
}.items():
    app.command(epilog=f"Example: {example}")(command)
app.add_typer(eval.app, name="eval")
app.add_typer(server.keys, name="keys")
app.add_typer(models.app, name="models")

if __name__ == "__main__":
    sys.exit(app())
