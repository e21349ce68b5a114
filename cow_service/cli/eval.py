"""`cow eval`: does imagination help a multimodal LLM, by how much, and at what cost."""

import sys
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer.core import TyperGroup

from cow_service.cli.batch import EXIT_INTERRUPTED, EXIT_SOME_FAILED
from cow_service.cli.options import Texts, argument, option, printable
from cow_service.client.options import CONCURRENCY
from cow_service.errors import CowError, install_line

_OF_EXTRA = ("inspect_ai", "pyarrow", "scipy", "matplotlib", "json_repair", "pydantic_ai", "tenacity")


class EvalsNotInstalled(CowError):
    """The Python packages of the evaluation are not installed."""

    code, status = "evals-not-installed", 0


class _RunByDefault(TyperGroup):
    """`cow eval DATA` is `cow eval run DATA`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Puts the name of the command in front where there is none."""
        if args and args[0] not in self.commands:
            args = ["run", *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=_RunByDefault,
    rich_markup_mode=None,
    no_args_is_help=True,
    help="Measure whether imagination helps: cow eval DATA asks, cow eval report RUNS compares.",
)

Out = Annotated[Path, option("Folder of the run; one in it is gone on with.", "--out", "-o")]
Prices = Annotated[
    Path | None, option("YAML or JSON: {MODEL: {input: 1.25, output: 10}}, per million tokens.", shown="none")
]


@app.command()
def run(
    data: Annotated[
        str,
        argument(
            "A folder in CausalSpatial's layout, a folder of scenes, a file (JSONL, CSV, TSV, Parquet), or the "
            "name of a data set of the Hugging Face hub, such as Mwxinnn/CausalSpatial."
        ),
    ],
    out: Out,
    mllm: Annotated[
        str | None, option("The multimodal LLM, as Inspect names it: openai/gpt-5.", shown="the embedded reader")
    ] = None,
    arm: Annotated[
        Texts,
        option(
            "never, always, auto, best-of-K, placebo-still, placebo-direction, encounters, frames-only, oracle; "
            "may be repeated, or several with commas.",
            shown="never,always",
        ),
    ] = None,
    repeats: Annotated[int, option("How often each question is asked in each arm.", min=1)] = 1,
    ask: Annotated[
        Literal["prompt", "answer"] | None,
        option(
            "prompt: the paper's prompt, with frames of /simulate; answer: the service's own /answer.",
            shown="prompt with --mllm, else answer",
        ),
    ] = None,
    subset: Annotated[Texts, option("Of CausalSpatial's layout only these; may be repeated.")] = None,
    limit: Annotated[int | None, option("Only the first so many questions.", min=1, shown="all")] = None,
    seed: Annotated[int, option("Of the order in which options are shown.")] = 0,
    reader: Annotated[
        str | None, option("Who grounds and reads motion for the imagination.", shown="the server's")
    ] = None,
    generator: Annotated[str | None, option("Who makes its frames.", shown="the server's")] = None,
    url: Annotated[str | None, option("The COW server.", shown="one is started in this process")] = None,
    base_url: Annotated[str | None, option("Where the multimodal LLM is served.", shown="the provider's")] = None,
    temperature: Annotated[float | None, option("Of its replies.", shown="the provider's")] = None,
    max_tokens: Annotated[int | None, option("Of a reply.", min=1, shown="8192")] = None,
    concurrency: Annotated[int, option("Most questions at the same time, in each arm.", min=1)] = CONCURRENCY,
    skip_faulty: Annotated[
        bool, option("Leave out rows that cannot be asked, and columns that mean nothing.", "--skip-faulty")
    ] = False,
    retry_failed: Annotated[bool, option("Ask those again that failed.", "--retry-failed")] = False,
    log_images: Annotated[bool, option("Keep pictures in Inspect's logs, for inspect view.")] = True,
    prices: Prices = None,
) -> None:
    """Ask every question in every arm, and report. `cow eval report RUNS` compares runs.

    The same command resumes a run that was interrupted; no reply that has come is asked for again.

    Exit code 0: all were asked; 3: some failed, with their reasons in the report; 1: the run could not begin or go on.
    """
    given = locals()
    _check_installed()
    from cow_service.evals.plan import Plan  # noqa: PLC0415
    from cow_service.evals.run import evaluate  # noqa: PLC0415
    from cow_service.evals.runs import REPORT  # noqa: PLC0415

    arms = [name.strip() for text in arm or ["never,always"] for name in text.split(",") if name.strip()]
    fields: dict[str, Any] = {name: given[name] for name in Plan.__dataclass_fields__.keys() & given.keys()}
    fields |= {"ask": ask or ("answer" if mllm is None else "prompt"), "arms": arms, "subsets": tuple(subset or ())}
    plan = Plan(**fields)
    priced = _priced(prices)
    try:
        done = evaluate(plan, lambda told: typer.echo(printable(told), err=True))
    except KeyboardInterrupt:
        typer.echo("Interrupted. The same command goes on with it.", err=True)
        sys.stderr.flush()
        raise typer.Exit(EXIT_INTERRUPTED) from None
    _report([done], out / REPORT, priced)
    failed = sum(each.failure is not None for each in done.observations)
    unasked = len(done.items) * len(done.info.arms) * done.info.repeats - len(done.observations)
    if failed:
        typer.echo(f"{failed} questions failed; the report says why. --retry-failed asks them again.", err=True)
    elif unasked:
        typer.echo(f"{unasked} questions were not asked. The same command goes on with it.", err=True)
    if failed or unasked:
        raise typer.Exit(EXIT_SOME_FAILED)


@app.command()
def report(
    runs: Annotated[list[Path], argument("Folders that `cow eval --out` wrote.", "RUNS")],
    out: Annotated[Path | None, option("Folder for the report.", "--out", "-o", shown="RUN/report")] = None,
    prices: Prices = None,
) -> None:
    """Compare runs: tables, plots and a page that opens without a server."""
    _check_installed()
    from cow_service.evals.runs import REPORT, read_run  # noqa: PLC0415

    priced = _priced(prices)
    _report([read_run(folder) for folder in runs], out or runs[0] / REPORT, priced)


def _report(runs: list[Any], out: Path, prices: dict[str, Any]) -> None:
    """Writes a report, and prints its table."""
    from cow_service.evals.report.write import write_report  # noqa: PLC0415

    typer.echo(printable(write_report(runs, out, prices)))
    typer.echo(f"\nThe report, with every item: {out / 'index.html'}")


def _priced(path: Path | None) -> dict[str, Any]:
    from cow_service.evals.report.summary import read_prices  # noqa: PLC0415

    return {} if path is None else read_prices(path)


def _check_installed() -> None:
    """Raises `EvalsNotInstalled`."""
    from importlib.util import find_spec  # noqa: PLC0415

    missing = [name for name in _OF_EXTRA if find_spec(name) is None]
    if missing:
        raise EvalsNotInstalled(f"`cow eval` needs {', '.join(missing)}: {install_line('evals')}")
