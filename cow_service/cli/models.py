"""`cow models`: lists backends, downloads weights and verifies them. Heavy imports are inside the commands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cow_service.cli.options import EXISTING, AsJson, FolderNotWritable, Texts, argument, option, writable
from cow_service.cli.server import open_service
from cow_service.errors import InvalidRequest

if TYPE_CHECKING:
    from cow_service.weights.manifests import Manifest, Source
    from cow_service.weights.repositories import Download

app = typer.Typer(rich_markup_mode=None, epilog="Example: cow models pull ati")

Name = Annotated[str, argument("Name of the model, as `cow models` lists it.", "NAME")]


@app.callback(invoke_without_command=True)
def models(context: typer.Context, as_json: AsJson = False) -> None:
    """List models and whether they are ready; pull and check weights.

    Readers understand the question, generators make the frames, and vision models find objects and measure depth.
    """
    if context.invoked_subcommand is not None:
        if as_json:
            raise typer.BadParameter("--json goes after the command.")
        return
    from cow_service.cli.console import print_models  # noqa: PLC0415

    print_models(open_service().models(), as_json=as_json)


@app.command(epilog="Example: cow models pull ati")
def pull(
    name: Name,
    revision: Annotated[
        Texts,
        option(
            "Branch, tag or commit, for all parts or for one; may be repeated.",
            metavar="[PART=]REV",
            shown="the revision pulled before, else the newest",
        ),
    ] = None,
) -> None:
    """Download a model's weights and check every file.

    NAME may also be a value of COW_PERCEPTION, such as cpu. Files that are already here are kept.
    """
    from cow_service.perception.base import SETS  # noqa: PLC0415

    for each in SETS.get(name, (name,)):
        _pull(each, revision)


def _pull(name: str, revision: list[str] | None) -> None:
    manifest = _manifest(name)
    revisions = _revisions(manifest, revision or [])
    if not manifest.sources:
        typer.echo(f"{name} needs no weights.")
        return
    from rich.filesize import decimal  # noqa: PLC0415

    from cow_service.settings import load_settings  # noqa: PLC0415
    from cow_service.weights.repositories import download, folder_of  # noqa: PLC0415

    weights_dir = load_settings().weights_dir
    typer.echo("Comparing the repository with the files that are here ...")
    downloads = _downloads(manifest, weights_dir, revisions)
    files = [file for each in downloads for file in each.files]
    pending = [file for each in downloads for file in each.pending]
    size, missing = (decimal(sum(file.size for file in some)) for some in (files, pending))
    typer.echo(f"{name}: {len(files)} files, {size}; to download: {len(pending)} files, {missing}.")
    download(downloads, weights_dir, lambda repo, file: typer.echo(f"{repo}: {file.path}, {decimal(file.size)}"))
    for each in downloads:
        folder = folder_of(weights_dir, each.lock.repository)
        typer.echo(f"{each.lock.repository} at {each.lock.revision[:12]} is in {folder}")


@app.command(epilog="Example: cow models check --save")
def check(
    name: Annotated[str | None, argument("Model whose weights are checked; without one, COW_MLLM is.", "NAME")] = None,
    save: Annotated[bool, option("Keep what was measured: readings then count as that exact.", "--save")] = False,
    as_json: AsJson = False,
) -> None:
    """Check that a model's weights are complete or, without a name, what the multimodal LLM can do.

    That is asked for boxes, directions and senses in pictures whose answers are known, for JSON, and about several
    images. Exit code 1 if anything is missing or not good.
    """
    if name is None:
        _check_mllm(save=save, as_json=as_json)
        return
    if save:
        raise InvalidRequest("--save is for the check of COW_MLLM: leave the name out.")
    from cow_service.settings import load_settings  # noqa: PLC0415
    from cow_service.weights import repositories as weights  # noqa: PLC0415

    manifest, weights_dir = _manifest(name), load_settings().weights_dir
    findings = {part: weights.check(source, weights_dir) for part, source in manifest.sources.items()}
    complete = not any(findings.values())
    if as_json:
        parts = {part: [finding.model_dump() for finding in found] for part, found in findings.items()}
        typer.echo(json.dumps({"name": name, "complete": complete, "findings": parts}, indent=2))
    elif not findings:
        typer.echo(f"{name} needs no weights.")
    else:
        for part, found in findings.items():
            source = manifest.sources[part]
            typer.echo(f"{part} ({source.repository}, {source.licence}): {'not complete' if found else 'complete'}")
            for finding in found:
                typer.echo(f"  {finding.message}")
    if not complete:
        typer.echo(f"Run `cow models pull {name}`.", err=True)
        if manifest.role == "mllm":
            typer.echo("To check the MLLM of COW_MLLM, wherever it is served, leave the name out.", err=True)
        raise typer.Exit(1)


def _check_mllm(*, save: bool, as_json: bool) -> None:
    """Raises `ReaderUnavailable` where none is set up."""
    from cow_service.cli.console import print_check  # noqa: PLC0415
    from cow_service.readers.mllm.reader import MllmReader  # noqa: PLC0415

    with open_service() as service:
        reader = service.chat_reader("local" if service.settings.reader == "local" else "mllm")
        if not isinstance(reader, MllmReader):
            raise InvalidRequest("The configured reader is not one of COW's own: only those can be checked.")
        found, problem = reader.check(), None
        if kept := found.measured if save else None:
            try:
                reader.keep(kept)
            except OSError as error:
                problem = FolderNotWritable(f"Cannot write to COW_DATA_DIR, '{service.settings.data_dir}': {error}.")
        if as_json:
            typer.echo(found.model_dump_json(indent=2))
        else:
            print_check(found, service.models().mllm, is_kept=kept is not None and problem is None)
    if problem is not None:
        raise problem
    if not all(finding.usable for finding in found.findings):
        raise typer.Exit(1)


def _manifest(name: str) -> Manifest:
    from cow_service.weights.manifests import load_manifests  # noqa: PLC0415

    manifests = load_manifests()
    if name not in manifests:
        known = ", ".join(sorted(each for each, manifest in manifests.items() if manifest.sources))
        raise InvalidRequest(f"There is no model '{name}'. Models with weights to download: {known or 'none'}.")
    return manifests[name]


def _revisions(manifest: Manifest, wanted: list[str]) -> dict[str, str]:
    """The given revisions by part. Raises `InvalidRequest` for a part that does not exist."""
    revisions: dict[str, str] = {}
    for each in wanted:
        part, _, revision = each.rpartition("=")
        if part and part not in manifest.sources:
            parts = ", ".join(manifest.sources) or "none"
            raise InvalidRequest(f"--revision {each}: '{manifest.name}' has no part '{part}'. Its parts: {parts}.")
        revisions |= {part: revision} if part else dict.fromkeys(manifest.sources, revision)
    return revisions


def _downloads(manifest: Manifest, weights_dir: Path, revisions: dict[str, str]) -> list[Download]:
    """One download per repository: parts from the same repository share its folder and revision."""
    from cow_service.weights.repositories import resolve  # noqa: PLC0415

    sources: dict[str, Source] = {}
    chosen: dict[str, str] = {}
    for part, source in manifest.sources.items():
        known = sources.get(source.repository, source)
        files = tuple(dict.fromkeys((*known.files, *source.files)))
        sources[source.repository] = known.model_copy(update={"files": files})
        if part in revisions and chosen.setdefault(source.repository, revisions[part]) != revisions[part]:
            raise InvalidRequest(f"All parts from '{source.repository}' share a folder: give them one --revision.")
    return [resolve(source, weights_dir, chosen.get(name)) for name, source in sources.items()]


def tracks(
    simulation: Annotated[Path, argument("A simulation.json.", "SIMULATION", **EXISTING)],
    out: Annotated[Path, option("tracks.pth or .npz for ATI, tracks.npy for Wan-Move.", "--out", "-o")],
) -> None:
    """Write a simulation's point paths for ATI or Wan-Move.

    Both video models take tracks, paths of points: first of moving objects, then of still ones, then of the background.
    """
    from pydantic import ValidationError  # noqa: PLC0415

    from cow_service.generators.wan.tracks import CLIP_FPS, clip_length, tracks_of, write_tracks  # noqa: PLC0415
    from cow_service.physics.tracks import at_rate  # noqa: PLC0415
    from cow_service.records import Simulation  # noqa: PLC0415

    try:
        record = Simulation.model_validate_json(simulation.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the file"
        raise InvalidRequest(f"{simulation.name} is not a simulation: {place}: {first['msg']}.") from error
    if not record.trajectory.path.states:
        raise InvalidRequest(f"{simulation.name} is a minimal result without tracks: ask without `return=minimal`.")
    length = clip_length(record.trajectory.num_frames, record.trajectory.fps, CLIP_FPS)
    trajectory = at_rate(record.trajectory, CLIP_FPS, length)
    found = tracks_of(trajectory, record.image.width, record.image.height)
    with writable(out):
        written = write_tracks(found, out)
    anchors, still = len(trajectory.anchors), sum(len(each.points) for each in trajectory.still_tracks)
    moving = found.points.shape[1] - still - anchors
    names = " and ".join(str(path) for path in written)
    typer.echo(
        f"{moving} tracks of moving objects, {still} of still ones and {anchors} of the background over "
        f"{found.num_frames} frames at {CLIP_FPS:g} per second: {names}"
    )
