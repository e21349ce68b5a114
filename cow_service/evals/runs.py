"""A folder of results: the questions, and their outcomes, which are kept only in Inspect's logs."""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from inspect_ai import log as inspect_log
from pydantic import ValidationError

from cow_service.errors import InvalidRequest
from cow_service.evals.asking import Case, order_of, place_of
from cow_service.evals.design import arm_of
from cow_service.evals.items import Item, Observation
from cow_service.evals.plan import FORMAT, RunInfo

RUN, ITEMS = "run.json", "items.jsonl"  # what was asked
PICTURES = "pictures"  # by digest: images and frames
LOGS = "logs"  # Inspect's
CACHE = "cache"  # every reply that has come
SERVER = "server"  # the data and the log of a server in the process
REPORT = "report"
ITEM, OBSERVATION = "item", "observation"  # where a sample of a log holds them
# What a log holds beside: pictures and every step of the way.
_NOT_READ = {"messages", "events", "attachments", "output", "store", "timelines"}
_CANCELED = "CancelledError("  # how Inspect writes down what an interrupt cut off
MAX_FAILURE = 500  # characters


@dataclass(frozen=True)
class EvalRun:
    """A run with all that came of it. Its pictures are files of `pictures`, named by digest."""

    folder: Path
    info: RunInfo
    items: dict[str, Item]
    observations: tuple[Observation, ...]

    def of_arm(self, arm: str) -> list[Observation]:
        """The observations of one arm."""
        return [each for each in self.observations if each.arm == arm]


def write_run(folder: Path, info: RunInfo, items: Iterable[Item]) -> None:
    """Writes the design of the run, before anything is asked."""
    lines = "".join(item.model_dump_json() + "\n" for item in items)
    for name, text in ((ITEMS, lines), (RUN, info.model_dump_json(indent=2) + "\n")):
        partial = folder / f".{name}.partial"
        partial.write_text(text, encoding="utf-8")
        partial.replace(folder / name)


def read_info(folder: Path) -> RunInfo | None:
    """What a folder was asked; None if no run was begun in it. Raises `InvalidRequest` for one that is damaged."""
    path = folder / RUN
    try:
        found: Any = json.loads(path.read_bytes()) if path.is_file() else None
        if isinstance(found, dict) and found.get("format") != FORMAT:
            raise InvalidRequest(
                f"'{folder}' holds a run that another version of COW wrote (format {found.get('format')}, not "
                f"{FORMAT}), whose arms showed other frames: choose another folder with --out."
            )
        return None if found is None else RunInfo.model_validate(found)
    except (ValueError, OSError) as error:
        raise _unreadable(folder, RUN, error) from error


def read_run(folder: Path) -> EvalRun:
    """A run and its outcomes so far. Raises `InvalidRequest` for a folder without a run."""
    info = read_info(folder)
    if info is None:
        raise InvalidRequest(f"'{folder}' holds no {RUN}: name the folder that `cow eval --out` wrote.")
    try:
        lines = (folder / ITEMS).read_bytes().splitlines()
        items = {item.id: item for item in map(Item.model_validate_json, lines)}
    except (ValidationError, OSError) as error:
        raise _unreadable(folder, ITEMS, error) from error
    return EvalRun(folder, info, items, tuple(read_observations(folder / LOGS)))


def _unreadable(folder: Path, name: str, error: Exception) -> InvalidRequest:
    reason = str(error).splitlines()[0]
    return InvalidRequest(f"'{folder}' holds no complete run: {name} cannot be read ({reason}). Run `cow eval` again.")


def read_observations(folder: Path) -> list[Observation]:
    """The observations of all logs of a folder; of a question that was asked again, the last."""
    found: dict[tuple[str, str, int], Observation] = {}
    for info in inspect_log.list_eval_logs(str(folder), descending=False):  # the oldest first
        log = inspect_log.read_eval_log(info, exclude_fields=_NOT_READ)
        for sample in log.samples or ():
            each = _observation(log, sample)
            if each is not None:
                place = each.arm, each.item, each.repeat
                before = found.get(place)
                if before is None or before.failure is not None or each.failure is None:
                    found[place] = each
    return list(found.values())


def _observation(log: inspect_log.EvalLog, sample: inspect_log.EvalSample) -> Observation | None:
    """What came of a sample; None if it was canceled."""
    for score in (sample.scores or {}).values():
        if score.metadata and OBSERVATION in score.metadata:
            return Observation.model_validate(score.metadata[OBSERVATION])
    if sample.error is None or (log.status == "cancelled" and sample.error.message.startswith(_CANCELED)):
        return None
    arguments: dict[str, Any] = log.plan.steps[0].params
    item = Item.model_validate(sample.metadata[ITEM])
    order = order_of(item, arguments["order"], arguments["seed"], sample.epoch)
    case = Case(item, arm_of(arguments["arm"]), sample.epoch, order)
    return Observation(**place_of(case), failure=sample.error.message[:MAX_FAILURE])


def forget_failures(folder: Path) -> int:
    """Marks failed questions to be asked again; returns their number."""
    count = 0
    for info in inspect_log.list_eval_logs(str(folder)):
        log = inspect_log.read_eval_log(info)
        failed = [sample.uuid for sample in log.samples or () if sample.error is not None and sample.uuid]
        if failed:
            why = inspect_log.ProvenanceData(author="cow eval", reason="asked again: --retry-failed")
            inspect_log.write_eval_log(inspect_log.invalidate_samples(log, failed, why), info.name)
            count += len(failed)
    return count
