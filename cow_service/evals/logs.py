"""Reads what came of a run from Inspect's logs, which are the only place where it stands."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from inspect_ai.log import (
    EvalLog,
    EvalSample,
    ProvenanceData,
    invalidate_samples,
    list_eval_logs,
    read_eval_log,
    write_eval_log,
)

from cow_service.evals.arms import arm_of
from cow_service.evals.asking import Case, place_of
from cow_service.evals.items import Item
from cow_service.evals.observations import Observation
from cow_service.evals.replies import order_of
from cow_service.evals.tasks import ITEM, OBSERVATION

# What a log holds beside: pictures and every step of the way.
_NOT_READ = {"messages", "events", "attachments", "output", "store", "timelines"}
_CANCELED = "CancelledError("  # how Inspect writes down what an interrupt cut off
MAX_FAILURE = 500  # characters


def read_observations(folder: Path) -> list[Observation]:
    """The observations of all logs of a folder; of a question that was asked again, the last."""
    found: dict[tuple[str, str, int], Observation] = {}
    for log in read_logs(folder):
        for sample in log.samples or ():
            each = _observation(log, sample)
            if each is not None:
                place = each.arm, each.item, each.repeat
                before = found.get(place)
                if before is None or before.failure is not None or each.failure is None:
                    found[place] = each
    return list(found.values())


def read_logs(folder: Path) -> Iterator[EvalLog]:
    """The logs of a folder, the oldest first, without pictures."""
    for info in list_eval_logs(str(folder), descending=False):
        yield read_eval_log(info, exclude_fields=_NOT_READ)


def _observation(log: EvalLog, sample: EvalSample) -> Observation | None:
    """What came of a sample; None where it was canceled."""
    for score in (sample.scores or {}).values():
        if score.metadata and OBSERVATION in score.metadata:
            return Observation.model_validate(score.metadata[OBSERVATION])
    if sample.error is None or (log.status == "cancelled" and sample.error.message.startswith(_CANCELED)):
        return None
    arguments: dict[str, Any] = log.plan.steps[0].params
    item = Item.model_validate(sample.metadata[ITEM])
    order = order_of(item, arguments["seed"], sample.epoch)
    case = Case(item, arm_of(arguments["arm"]), sample.epoch, order)
    return Observation(**place_of(case), failure=sample.error.message[:MAX_FAILURE])


def forget_failures(folder: Path) -> int:
    """Marks what failed, so that it is asked again; returns how many there were."""
    count = 0
    for info in list_eval_logs(str(folder)):
        log = read_eval_log(info)
        failed = [sample.uuid for sample in log.samples or () if sample.error is not None and sample.uuid]
        if failed:
            why = ProvenanceData(author="cow eval", reason="asked again: --retry-failed")
            write_eval_log(invalidate_samples(log, failed, why), info.name)
            count += len(failed)
    return count
