"""The commands `cow-scenes eye`: draw, train, ship, measure. Each goes on where it stopped."""

import json
import multiprocessing
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import CheckError, UsageError
from . import require_libraries

if TYPE_CHECKING:
    from .evaluate import Score

app = typer.Typer(no_args_is_help=True)
# The libraries of the extra `eye` are imported by these commands alone: the others do without them.


@app.callback()
def check_libraries() -> None:
    """Pictures drawn for looking, and the network that learns from them."""
    require_libraries()


def draw_groups(folder: Path, seed: int, groups: list[int]) -> None:
    """Draw the shards of some groups; what one process does, with one thread."""
    os.environ["LP_NUM_THREADS"] = "1"  # read by OSMesa when its first context is made
    import cv2  # noqa: PLC0415

    from .pictures import Pen, write_shard  # noqa: PLC0415

    cv2.setNumThreads(1)
    with Pen():
        for group in groups:
            write_shard(folder, seed, group)


@app.command()
def draw(
    out: Annotated[Path, typer.Option(help="Folder of the shards.")],
    count: Annotated[int, typer.Option(help="Pictures, rounded up to whole shards.")] = 30_000,
    seed: Annotated[int, typer.Option(help="Picture N of a seed is always the same.")] = 1,
    processes: Annotated[int, typer.Option(help="Processes that draw.")] = 1,
) -> None:
    """Draw pictures with their truth."""
    from .pictures import PER_STAGE  # noqa: PLC0415

    groups = list(range(-(-count // PER_STAGE)))
    context = multiprocessing.get_context("spawn")
    workers = [context.Process(target=draw_groups, args=(out, seed, groups[k::processes])) for k in range(processes)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    if any(worker.exitcode for worker in workers):
        raise CheckError(f"a process that draws into {out} failed; the same command goes on")
    print(f"{len(groups) * PER_STAGE} pictures in {out}")


@app.command()
def train(
    pictures: Annotated[Path, typer.Option(help="Folder of shards; it may grow meanwhile.")],
    held: Annotated[Path, typer.Option(help="Folder of shards that are not learned from.")],
    out: Annotated[Path, typer.Option(help="Folder of checkpoint, log and weights.")],
    steps: Annotated[int, typer.Option(help="Batches of 16 cuttings or 4 whole pictures.")] = 20_000,
    rate: Annotated[float, typer.Option(help="Largest step size.")] = 3e-3,
    seed: Annotated[int, typer.Option(help="Seed of weights and batches.")] = 1,
    threads: Annotated[int, typer.Option(help="Threads of torch, without a GPU.")] = 2,
    start: Annotated[Path | None, typer.Option(help="`weights.pt` of another run, to begin with.", exists=True)] = None,
) -> None:
    """Train the network."""
    from . import training  # noqa: PLC0415

    if not any(pictures.glob("seed*.npz")):
        raise UsageError(f"{pictures} has no shard; run `cow-scenes eye draw --out {pictures}` first")
    training.train(pictures, held, out, training.Recipe(steps, rate, seed, threads), start)


@app.command()
def ship(
    run: Annotated[Path, typer.Argument(help="Folder of a training.")],
    weights: Annotated[Path, typer.Argument(help="ONNX file to write; the card NAME.json is written beside it.")],
    held: Annotated[Path, typer.Option(help="Shards to calibrate on, not learned from.")],
    scenes: Annotated[list[str] | None, typer.Option(help="NAME=FOLDER of scenes to measure on.")] = None,
    note: Annotated[str, typer.Option(help="What the recipe says beyond its numbers.")] = "",
) -> None:
    """Export, calibrate, measure, and write the card."""
    import torch  # noqa: PLC0415

    from .calibrate import calibrated  # noqa: PLC0415
    from .card import LARGEST, write_card  # noqa: PLC0415
    from .decode import Calibration, Eye, Limits  # noqa: PLC0415
    from .export import export  # noqa: PLC0415
    from .network import Network  # noqa: PLC0415
    from .pictures import Shard  # noqa: PLC0415

    network = Network()
    network.load_state_dict(torch.load(run / "weights.pt", weights_only=True))
    export(network, weights)
    if weights.stat().st_size > LARGEST:
        raise CheckError(f"{weights} has {weights.stat().st_size} bytes, more than {LARGEST}")
    last = json.loads((run / "log.jsonl").read_text().splitlines()[-1])
    recipe = {"steps": last["step"], "hours": round(last["seconds"] / 3600, 2), "pictures": last["pictures"]}
    recipe |= {"held out": last["held out"], "note": note}
    write_card(weights, Limits(), {False: Calibration(), True: Calibration()}, recipe, {})
    shards = [Shard(path) for path in sorted(held.glob("seed*.npz"))]
    limits, fits = calibrated(Eye(weights), [shard[k] for shard in shards for k in range(len(shard))])
    write_card(weights, limits, fits, recipe, {})
    write_card(weights, limits, fits, recipe, dict(measurements(weights, scenes or [])))


def measurements(weights: Path, named: list[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Figures and reliability by family, from NAME=FOLDER; families with the same name are one."""
    import cv2  # noqa: PLC0415

    from .decode import Eye  # noqa: PLC0415
    from .evaluate import look_at, reliability, summary  # noqa: PLC0415

    cv2.setNumThreads(1)
    eye, families = Eye(weights), dict[str, list["Score"]]()
    for pair in named:
        name, _, folder = pair.partition("=")
        if not Path(folder).is_dir():
            raise UsageError(f"{pair!r}: give NAME=FOLDER with a folder of scenes")
        families.setdefault(name, []).extend(look_at(Path(folder), eye))
    for name, scores in families.items():
        yield name, {**summary(scores), "reliability": reliability(scores)}


@app.command()
def measure(
    weights: Annotated[Path, typer.Argument(help="ONNX file with its card beside it.", exists=True, dir_okay=False)],
    scenes: Annotated[list[str], typer.Argument(help="NAME=FOLDER of scenes with ids.png and meta.json.")],
) -> None:
    """Measure weights on folders of scenes with true masks; one thread."""
    for name, figures in measurements(weights, scenes):
        print(json.dumps({name: figures}))
