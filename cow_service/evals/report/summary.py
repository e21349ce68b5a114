"""What a report says: rates, gains, calibration and cost of every arm of every run, computed once for all its forms."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import Field, TypeAdapter, ValidationError

from cow_service.errors import InvalidRequest
from cow_service.evals import statistics
from cow_service.evals.items import TASKS, Observation, Task
from cow_service.evals.runs import EvalRun
from cow_service.evals.statistics import Calibration, Cost, Gain, Rates
from cow_service.records import Record

BASELINE = "never"


class ArmSummary(Record):
    """What one arm of one run came to."""

    run: int = Field(description="Place of the run in the report, from 0.")
    arm: str
    name: str = Field(description="Unique in the report: the arm, and the multimodal LLM where there are several.")
    rates: Rates
    cells: dict[tuple[str, str | None], Rates] = Field(description="By task and level; level null: all levels.")
    baseline: int | None = Field(description="The run whose arm `never` it is compared with; null for that arm.")
    gain: Gain | None = Field(default=None, description="Over the arm `never`; null for itself, or without one.")
    gains: dict[str, Gain] = Field(description="The same per task, p values adjusted over them.")
    calibration: Calibration | None = None
    cost: Cost


class Price(Record):
    """Of a million tokens."""

    input: float = Field(ge=0)
    output: float = Field(ge=0)


def summarize(runs: Sequence[EvalRun], prices: Mapping[str, Price] | None = None) -> tuple[ArmSummary, ...]:
    """Of every arm that has replies, in the order of the runs and of their arms."""
    found: list[ArmSummary] = []
    for place, run in enumerate(runs):
        for arm in run.info.arms:
            observations = run.of_arm(arm)
            of_all = statistics.rates(observations)
            if of_all is None:
                continue
            name = f"{run.info.mllm}, {arm}" if len(runs) > 1 else arm
            compared = None if arm == BASELINE else baseline_run(runs, run)
            baseline = [] if compared is None else compared.of_arm(BASELINE)
            price = (prices or {}).get(run.info.mllm)
            paid = () if price is None else (price.input, price.output)
            found.append(
                ArmSummary(
                    run=place,
                    arm=arm,
                    name=f"{name} ({place + 1})" if any(each.name == name for each in found) else name,
                    rates=of_all,
                    cells=_cells(observations),
                    baseline=None if compared is None else runs.index(compared),
                    gain=statistics.gain(observations, baseline),
                    gains=_gains(observations, baseline),
                    calibration=statistics.calibration(observations),
                    cost=statistics.cost(observations, *paid),
                )
            )
    return tuple(found)


def baseline_run(runs: Sequence[EvalRun], run: EvalRun) -> EvalRun | None:
    """The run with the replies without imagination: itself, else the first that asked the same of the same model."""
    same = (other for other in runs if other is not run and other.info.baseline_key == run.info.baseline_key)
    return next((each for each in (run, *same) if each.of_arm(BASELINE)), None)


def _cells(observations: Sequence[Observation]) -> dict[tuple[str, str | None], Rates]:
    """Per task: all of it, then its levels."""
    cells: dict[tuple[str, str | None], Rates] = {}
    for task, of_task in _by_task(observations).items():
        for level in (None, *sorted({each.level for each in of_task})):
            of_level = statistics.rates([each for each in of_task if level in (None, each.level)])
            if of_level is not None:
                cells[task, level] = of_level
    return cells


def _gains(observations: Sequence[Observation], baseline: Sequence[Observation]) -> dict[str, Gain]:
    there = _by_task(baseline)
    found = {task: statistics.gain(seen, there.get(task, [])) for task, seen in _by_task(observations).items()}
    known = {task: gain for task, gain in found.items() if gain is not None}
    adjusted = statistics.holm([gain.p for gain in known.values()])
    return {task: known[task].model_copy(update={"p_holm": p}) for task, p in zip(known, adjusted, strict=True)}


def _by_task(observations: Sequence[Observation]) -> dict[Task, list[Observation]]:
    found: dict[Task, list[Observation]] = defaultdict(list)
    for each in observations:
        found[each.task].append(each)
    return {task: found[task] for task in TASKS if task in found}


_TABLE: TypeAdapter[dict[str, Price]] = TypeAdapter(dict[str, Price])


def read_prices(path: Path) -> dict[str, Price]:
    """The prices of models, by their names. Raises `InvalidRequest` for a file that is none."""
    try:
        told: Any = yaml.safe_load(path.read_bytes())
        return _TABLE.validate_python(told)
    except OSError as error:
        raise InvalidRequest(f"The prices '{path}' cannot be read: {error.strerror or error}.") from error
    except (yaml.YAMLError, ValidationError) as error:
        raise InvalidRequest(
            f"'{path}' holds no prices: it must be like {{openai/gpt-5: {{input: 1.25, output: 10}}}}, per million "
            f"tokens. {str(error).splitlines()[0]}"
        ) from error
