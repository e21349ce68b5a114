"""`cow tracks`: converts trajectories to track files of ATI and Wan-Move, and back. Heavy imports stand inside."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from cow_service.errors import InvalidRequest

if TYPE_CHECKING:
    from pydantic import ValidationError

Result = TypeVar("Result")

app = typer.Typer(
    rich_markup_mode=None, no_args_is_help=True, help="Write and read the track files of ATI and Wan-Move."
)

ANCHOR_MAX_MOVE_PX = 1.0  # a track that never moves further from its start is an anchor


@app.command(name="export")
def export_tracks(
    simulation: Annotated[
        Path, typer.Argument(metavar="SIMULATION", help="A simulation.json.", exists=True, dir_okay=False)
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="tracks.pth or .npz for ATI, tracks.npy for Wan-Move.")],
) -> None:
    """Write a simulation's tracks, in pixels of its input image: of what moves, the mover's first, then the anchors."""
    from pydantic import ValidationError  # noqa: PLC0415

    from cow_service.generators.wan.track_files import write_tracks  # noqa: PLC0415
    from cow_service.generators.wan.tracks import tracks_of  # noqa: PLC0415
    from cow_service.records import Simulation  # noqa: PLC0415

    try:
        record = Simulation.model_validate_json(simulation.read_bytes())
    except ValidationError as error:
        raise _invalid(f"{simulation.name} is not a simulation", error, "the file") from error
    if not record.trajectory.path.states:
        raise InvalidRequest(f"{simulation.name} is a minimal result, without tracks: get it without `return=minimal`.")
    tracks = tracks_of(record.trajectory, record.image.width, record.image.height)
    written = _written(out, lambda: write_tracks(tracks, out))
    still = len(record.trajectory.anchors)
    moving = tracks.points.shape[1] - still
    names = " and ".join(str(path) for path in written)
    typer.echo(f"{moving} moving and {still} static tracks over {tracks.num_frames} frames: {names}")


@app.command(name="import")
def import_tracks(
    file: Annotated[Path, typer.Argument(metavar="FILE", help=".pth, .npz or .npy.", exists=True, dir_okay=False)],
    visibility: Annotated[
        Path | None,
        typer.Option(
            help="Wan-Move's other file.", exists=True, dir_okay=False, show_default="FILE's name with -visibility"
        ),
    ] = None,
    fps: Annotated[float, typer.Option(help="Frames per second of the clip.")] = 16,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Where to write it.", show_default="standard output")
    ] = None,
) -> None:
    """Turn a track file into the `trajectory` of a request, for `cow simulate --trajectory` or `POST /simulate`.

    Tracks that stay where they are become anchors. `points` is the mean of those that move.
    """
    import numpy as np  # noqa: PLC0415
    from pydantic import ValidationError  # noqa: PLC0415

    from cow_service.generators.wan.track_files import read_tracks  # noqa: PLC0415
    from cow_service.requests import TrajectoryRequest  # noqa: PLC0415

    read = read_tracks(file, visibility)
    if not read.visible.any():
        raise InvalidRequest(f"{file.name} has {read.points.shape[1]} tracks, and none of them is ever visible.")
    tracks = read.held()
    moves = (
        np.abs(tracks.points - tracks.points[:1]).max(axis=(0, 2)) > ANCHOR_MAX_MOVE_PX
        if tracks.points.size
        else np.zeros(0, bool)
    )
    if not moves.any():
        raise InvalidRequest(
            f"{file.name} has {moves.size} tracks, and none of them moves by more than {ANCHOR_MAX_MOVE_PX:g} px."
        )
    moving = tracks.points[:, moves].astype(float).round(3)
    try:
        trajectory = TrajectoryRequest(
            points=tuple(map(tuple, moving.mean(axis=1).round(3).tolist())),
            fps=fps,
            visible=tuple(map(bool, np.any(tracks.visible[:, moves], axis=1).tolist())),
            tracks_visible=tuple(tuple(map(bool, track)) for track in tracks.visible[:, moves].T.tolist()),
            tracks=tuple(tuple(map(tuple, track)) for track in moving.transpose(1, 0, 2).tolist()),
            anchors=tuple(map(tuple, tracks.points[0, ~moves].astype(float).round(3).tolist())),
        )
    except ValidationError as error:
        raise _invalid(f"{file.name} does not make a trajectory", error, "trajectory") from error
    if out is None:
        typer.echo(trajectory.model_dump_json())
        return
    _written(out, lambda: out.write_text(trajectory.model_dump_json(), encoding="utf-8"))
    typer.echo(f"{int(moves.sum())} moving and {int((~moves).sum())} static tracks: {out}")


def _invalid(fault: str, error: ValidationError, whole: str) -> InvalidRequest:
    """The first fault of a file, with its place; `whole` names the place where it is none of the fields."""
    first = error.errors()[0]
    place = ".".join(map(str, first["loc"])) or whole
    return InvalidRequest(f"{fault}: {place}: {first['msg']}.")


def _written(out: Path, write: Callable[[], Result]) -> Result:
    try:
        return write()
    except OSError as error:
        raise InvalidRequest(f"'{out}' cannot be written: {error.strerror}. Choose another file with --out.") from error
