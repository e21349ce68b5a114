"""`cow eval`: measures whether imagination helps a multimodal LLM, by how much, and at what cost."""

import sys
from collections.abc import Set as AbstractSet
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer.core import TyperGroup

from cow_service.cli.batch import EXIT_INTERRUPTED, EXIT_SOME_FAILED
from cow_service.cli.options import NotInstalled, Sharing, Texts, argument, option, printable
from cow_service.client import CONCURRENCY
from cow_service.errors import InvalidRequest, install_line

_OF_EXTRA = ("inspect_ai", "pyarrow", "scipy", "matplotlib", "json_repair", "pydantic_ai", "tenacity")


class _RunByDefault(TyperGroup):
    """`cow eval DATA` is `cow eval run DATA`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Adds the command `run` if none is named."""
        if args and args[0] not in (*self.commands, "--help"):
            args = ["run", *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=_RunByDefault,
    rich_markup_mode=None,
    no_args_is_help=True,
    help="Measure whether imagination helps a multimodal LLM.\n\nEvery question is asked in several arms, ways to ask "
    "it: with the image alone, with simulated frames, or with a placebo, frames that tell nothing about the future.",
    epilog="Example: cow eval DATA --mllm openai/gpt-5 --out run",
)

Out = Annotated[Path, option("Folder of the run; a run in it is resumed.", "--out", "-o")]
Prices = Annotated[
    Path | None, option("YAML or JSON, per million tokens: {MODEL: {input: 1.25, output: 10}}.", shown="none")
]
DATA = (
    "A folder in CausalSpatial's layout, a folder of scenes, a file (JSONL, CSV, TSV, Parquet), or the name of a data "
    "set on the Hugging Face hub, such as Mwxinnn/CausalSpatial."
)


def shared_options(
    mllm_revision: Annotated[
        str | None, option("Commit or snapshot of its weights, kept in the record.", shown="none")
    ] = None,
    arm: Annotated[
        Texts,
        option(
            "Ways to ask: never, always, auto, placebo-still, placebo-direction, placebo-item, encounters, "
            "frames-only, gate, oracle, each with suffixes such as :initial or :vote-3. May be repeated, or several "
            "names separated by commas.",
            shown="the preset's",
        ),
    ] = None,
    preset: Annotated[
        Literal["default", "paper", "controls"] | None,
        option(
            "Set of arms. default: with placebos; paper: the paper's protocol; controls: votes, gate, frames, words. "
            "Arms of --arm are added.",
            shown="default, or only the arms of --arm",
        ),
    ] = None,
    repeats: Annotated[
        int | None, option("How often each question is asked in each arm.", min=1, shown="the preset's: 1")
    ] = None,
    order: Annotated[
        Literal["shuffled", "data"] | None, option("Order of the options.", shown="the preset's: shuffled")
    ] = None,
    subset: Annotated[Texts, option("Only this subset of CausalSpatial's layout; may be repeated.")] = None,
    limit: Annotated[int | None, option("Only this many questions, from the first.", min=1, shown="all")] = None,
    seed: Annotated[int | None, option("Random seed of the order of options.", shown="0")] = None,
    reader: Annotated[str | None, option("Reader of the simulations (`cow models`).", shown="the server's")] = None,
    generator: Annotated[str | None, option("Generator of their frames.", shown="the server's")] = None,
    base_url: Annotated[str | None, option("URL of the server of the multimodal LLM.", shown="the provider's")] = None,
    temperature: Annotated[float | None, option("Sampling temperature of its replies.", shown="the provider's")] = None,
    max_tokens: Annotated[int | None, option("Most tokens in a reply.", min=1, shown="8192")] = None,
    skip_faulty: Annotated[bool, option("Skip faulty rows, and unknown columns.", "--skip-faulty")] = False,
    prices: Prices = None,
) -> dict[str, Any]:
    """The options that `run` and `plan` have both."""
    return locals()


class _WithShared(Sharing):
    reader = staticmethod(lambda: shared_options)


@app.command(cls=_WithShared, epilog="Example: cow eval run questions.jsonl --mllm openai/gpt-5 --out run")
def run(
    shared: typer.Context,
    out: Out,
    data: Annotated[str | None, argument(DATA)] = None,
    plan: Annotated[
        Path | None,
        option("File of `cow eval plan`: ask what it says, and report whether it was followed.", shown="none"),
    ] = None,
    mllm: Annotated[
        str | None, option("Multimodal LLM, as Inspect names it, such as openai/gpt-5.", shown="the embedded reader")
    ] = None,
    ask: Annotated[
        Literal["prompt", "answer"] | None,
        option(
            "prompt: the paper's prompt, with frames from /simulate; answer: the service's own /answer.",
            shown="prompt with --mllm, else answer",
        ),
    ] = None,
    url: Annotated[str | None, option("URL of the COW server.", shown="a server in this process")] = None,
    concurrency: Annotated[int, option("Most questions at the same time, in each arm.", min=1)] = CONCURRENCY,
    retry_failed: Annotated[bool, option("Ask failed questions again.", "--retry-failed")] = False,
    log_images: Annotated[bool, option("Keep pictures in Inspect's logs, for `inspect view`.")] = False,
) -> None:
    """Ask every question in every arm, and report.

    Run the same command again to resume; replies that were received are kept.

    Exit code 0: all were asked; 3: some failed, with their reasons in the report; 1: the run could not start or go on.
    """
    given = {**locals(), **shared.obj}
    _check_installed()
    from cow_service.evals.run import evaluate  # noqa: PLC0415
    from cow_service.evals.runs import REPORT  # noqa: PLC0415

    priced = _priced(shared.obj["prices"])
    wanted = _request(given)
    try:
        done = evaluate(wanted, lambda told: typer.echo(printable(told), err=True))
    except KeyboardInterrupt:
        typer.echo("Interrupted. Run the same command again to resume.", err=True)
        sys.stderr.flush()
        raise typer.Exit(EXIT_INTERRUPTED) from None
    _report([done], out / REPORT, priced)
    failed = sum(each.failure is not None for each in done.observations)
    unasked = len(done.items) * len(done.info.arms) * done.info.repeats - len(done.observations)
    if failed:
        typer.echo(f"{failed} questions failed; the report says why. Ask them again with --retry-failed.", err=True)
    elif unasked:
        typer.echo(f"{unasked} questions were not asked. Run the same command again to resume.", err=True)
    if failed or unasked:
        raise typer.Exit(EXIT_SOME_FAILED)


@app.command(cls=_WithShared, epilog="Example: cow eval plan questions.jsonl --mllm openai/gpt-5 --out plan.json")
def plan(
    shared: typer.Context,
    data: Annotated[str, argument(DATA)],
    out: Annotated[Path, option("The file to write.", "--out", "-o")],
    mllm: Annotated[str, option("Multimodal LLM, as Inspect names it, such as openai/gpt-5.")],
    effect: Annotated[float, option("Gain to detect, in percentage points.", min=0.01, max=100)] = 2.4,
    pilot: Annotated[
        Path | None, option("Folder of a smaller run, from which variance and costs are estimated.", shown="none")
    ] = None,
) -> None:
    """Fix the analysis before the run, and estimate its cost.

    The file names the primary question, its test and the scenes it needs. Nothing is asked yet: run it with
    `cow eval run --plan FILE --out DIR`. The report says whether the plan was followed.
    """
    given = {**locals(), **shared.obj, "ask": "prompt", "plan": None}
    _check_installed()
    from cow_service.evals.run import write_plan  # noqa: PLC0415

    typer.echo(printable(write_plan(_request(given), out, effect / 100, pilot, _priced(shared.obj["prices"]))))
    typer.echo(f"\nThe plan: {out}. Run it with: cow eval run --plan {out} --out DIR")


def _request(given: dict[str, Any]) -> Any:
    """The request in the options, completed from the plan or the preset. Raises `InvalidRequest`."""
    from cow_service.evals.request import EvalRequest  # noqa: PLC0415

    fields = {name: given[name] for name in EvalRequest.__dataclass_fields__.keys() & given.keys()}
    return EvalRequest(**fields | (_of_preset(given) if given["plan"] is None else _of_plan(given, fields.keys())))


def _of_plan(given: dict[str, Any], names: AbstractSet[str]) -> dict[str, Any]:
    """What a plan fixes of the fields of a request."""
    from cow_service.evals.plan import read_plan  # noqa: PLC0415

    fixed = read_plan(given["plan"])
    asked = (name for name in (*fixed.options, "arm", "preset", "repeats") if name in given)
    changed = [name for name in asked if given[name] is not None and given[name] is not False]
    if changed:
        raise InvalidRequest(f"The plan already sets --{changed[0].replace('_', '-')}: leave that option out.")
    own = {name: fixed.options[name] for name in names & fixed.options.keys()}
    subsets = tuple(fixed.options["subset"])
    return own | {"plan": fixed, "arms": tuple(fixed.arms), "repeats": fixed.repeats, "subsets": subsets}


def _of_preset(given: dict[str, Any]) -> dict[str, Any]:
    """What the options leave to the preset, and the arms of both."""
    from cow_service.evals.design import PRESETS  # noqa: PLC0415

    if given["data"] is None:
        raise InvalidRequest("Give the data to ask about, or a plan with --plan.")
    preset = PRESETS[given["preset"] or "default"]
    ask = given["ask"] or ("answer" if given["mllm"] is None else "prompt")
    named = [name for text in given["arm"] or () for name in text.split(",")]
    own = preset.arms if given["preset"] or not named else ()
    if given["preset"] is None and ask == "answer" and not named:
        own = ("never", "always")  # the service's own /answer shows no placebos
    return {
        "ask": ask,
        "arms": [*own, *(name.strip() for name in named if name.strip())],
        "repeats": given["repeats"] or preset.repeats,
        "seed": given["seed"] or 0,
        "order": given["order"] or preset.order,
        "subsets": tuple(given["subset"] or ()),
    }


@app.command(epilog="Example: cow eval report run-a run-b --out comparison")
def report(
    runs: Annotated[list[Path], argument("Folders of runs (--out of `cow eval`).", "RUNS")],
    out: Annotated[Path | None, option("Folder for the report.", "--out", "-o", shown="RUN/report")] = None,
    prices: Prices = None,
) -> None:
    """Compare runs in tables and plots."""
    _check_installed()
    from cow_service.evals.runs import REPORT, read_run  # noqa: PLC0415

    priced = _priced(prices)
    _report([read_run(folder) for folder in runs], out or runs[0] / REPORT, priced)


def _report(runs: list[Any], out: Path, prices: dict[str, Any]) -> None:
    """Writes a report, and prints its table."""
    from cow_service.evals.report.write import write_report  # noqa: PLC0415
    from cow_service.evals.runs import LOGS  # noqa: PLC0415

    typer.echo(printable(write_report(runs, out, prices)))
    logs = runs[0].folder / LOGS
    typer.echo(f"\nThe report: {out / 'report.md'}. Every question with its reply: inspect view --log-dir {logs}")


def _priced(path: Path | None) -> dict[str, Any]:
    from cow_service.evals.report.summary import read_prices  # noqa: PLC0415

    return {} if path is None else read_prices(path)


def _check_installed() -> None:
    """Raises `NotInstalled`."""
    missing = [name for name in _OF_EXTRA if find_spec(name) is None]
    if missing:
        raise NotInstalled(f"`cow eval` needs {', '.join(missing)}: {install_line('evals')}")
