"""What a report says of runs, computed once for all its forms: rates, contrasts, and why looking helps or hurts."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import yaml
from pydantic import Field, TypeAdapter, ValidationError

from cow_service.errors import InvalidRequest
from cow_service.evals import statistics
from cow_service.evals.design import BASELINE, Arm, primary, references
from cow_service.evals.items import TASKS, Observation, Task
from cow_service.evals.plan import departures
from cow_service.evals.runs import EvalRun
from cow_service.evals.statistics import Calibration, Cost, Gain, PrimaryGain, Rates
from cow_service.records import Record


class ArmSummary(Record):
    """What one arm of one run came to."""

    arm: str
    name: str = Field(description="Unique in the report: the arm, and the multimodal LLM where there are several.")
    rates: Rates
    cells: dict[tuple[str, str | None], Rates] = Field(description="By task and level; level null: all levels.")
    gain: Gain | None = Field(default=None, description="Over the arm `never`; null for itself, or without one.")
    gains: dict[str, Gain] = Field(description="The same per task.")
    calibration: Calibration | None = None
    cost: Cost


class Contrast(Record):
    """What one arm gains over another one."""

    name: str = Field(description="Of the arm, as in the report.")
    reference: str = Field(description="The arm that it is compared with.")
    task: str | None = Field(description="Null: all questions.")
    gain: Gain
    is_exploratory: bool = Field(description="The plan of the run does not have one of the arms.")
    abstains: bool = Field(description="The reference abstains always: what is gained is no more than right answers.")


class Primary(Record):
    """The primary question of a run."""

    name: str = Field(description="Of the arm, as in the report.")
    placebos: tuple[str, ...]
    found: PrimaryGain
    departures: tuple[str, ...] | None = Field(description="From the plan; null where there was none.")
    explored: tuple[str, ...] = Field(description="Arms that were asked besides those of the plan.")


class Split(Record):
    """The gain of simulated frames over the image alone, on a group of questions."""

    name: str
    by: str = Field(description="Property by which the questions are grouped.")
    value: str
    gain: Gain


class Findings(Record):
    """All that a report says."""

    arms: tuple[ArmSummary, ...]
    contrasts: tuple[Contrast, ...]
    primaries: tuple[Primary, ...]
    splits: tuple[Split, ...]


class Price(Record):
    """Of a million tokens."""

    input: float = Field(ge=0)
    output: float = Field(ge=0)


def summarize(runs: Sequence[EvalRun], prices: Mapping[str, Price] | None = None) -> Findings:
    """All that is found in these runs, in their order and that of their arms."""
    arms: list[ArmSummary] = []
    contrasts: list[Contrast] = []
    splits: list[Split] = []
    for place, run in enumerate(runs):
        for arm in run.info.points:
            observations = run.of_arm(arm.name)
            of_all = statistics.rates(observations)
            if of_all is None:
                continue
            name = f"{run.info.mllm}, {arm.name}" if len(runs) > 1 else arm.name
            name = f"{name} ({place + 1})" if any(each.name == name for each in arms) else name
            baseline = [] if arm.name == BASELINE else baseline_of(runs, run)
            own = _contrasts(name, run, arm, baseline)
            gains = {each.task: each.gain for each in own if each.reference == BASELINE}
            contrasts += own
            if arm.content == "simulated" and not arm.gate:
                splits += _splits(name, observations, baseline)
            price = (prices or {}).get(run.info.mllm)
            arms.append(
                ArmSummary(
                    arm=arm.name,
                    name=name,
                    rates=of_all,
                    cells=_cells(observations),
                    gain=gains.pop(None, None),
                    gains={str(task): gain for task, gain in gains.items()},
                    calibration=statistics.calibration(observations),
                    cost=statistics.cost(observations, *(() if price is None else (price.input, price.output))),
                )
            )
    primaries = filter(None, (_primary(run, several=len(runs) > 1) for run in runs))
    return Findings(arms=tuple(arms), contrasts=with_holm(contrasts), primaries=tuple(primaries), splits=tuple(splits))


def _contrasts(name: str, run: EvalRun, arm: Arm, baseline: Sequence[Observation]) -> list[Contrast]:
    """The gain of an arm on all questions; over the image alone also per task, if there are several."""
    found: list[Contrast] = []
    asked = {each.name: run.of_arm(each.name) for each in references(arm, run.info.points)}
    for reference, other in ({BASELINE: baseline} | asked).items():
        of_task = _by_task(run.of_arm(arm.name)) if reference == BASELINE else {}
        for task in (None, *(of_task if len(of_task) > 1 else ())):
            seen = run.of_arm(arm.name) if task is None else of_task[task]
            gain = statistics.gain(*matched(seen, [each for each in other if task in (None, each.task)]))
            if gain is not None:
                explored = run.info.plan is not None and not {arm.name, reference} <= run.info.plan.arms.keys()
                abstains = all(each.abstained for each in other if each.failure is None)
                told = Contrast(
                    name=name,
                    reference=reference,
                    task=task,
                    gain=gain,
                    is_exploratory=explored,
                    abstains=abstains,
                )
                found.append(told)
    return found


def with_holm(contrasts: Sequence[Contrast]) -> tuple[Contrast, ...]:
    """What a plan has is adjusted for itself: exploration must not cost it anything."""
    adjusted: dict[bool, Iterator[float]] = {}
    for is_exploratory in (False, True):
        adjusted[is_exploratory] = iter(
            statistics.holm([each.gain.p for each in contrasts if each.is_exploratory == is_exploratory])
        )
    gains = [each.gain.model_copy(update={"p_holm": next(adjusted[each.is_exploratory])}) for each in contrasts]
    return tuple(each.model_copy(update={"gain": gain}) for each, gain in zip(contrasts, gains, strict=True))


def matched(seen: Sequence[Observation], other: Sequence[Observation]) -> tuple[list[Observation], list[Observation]]:
    """Those that can be compared: where both arms are to show frames, pairs in which both showed equally many.

    A placebo cannot always be made, as where a motion has no opposite: such a pair would compare frames with none.
    """
    both = [{(each.item, each.repeat): len(each.frames) for each in side} for side in (seen, other)]
    if not all(any(shown.values()) for shown in both):
        return list(seen), list(other)
    kept = {place for place, count in both[0].items() if both[1].get(place) == count}
    return tuple([each for each in side if (each.item, each.repeat) in kept] for side in (seen, other))  # pyright: ignore[reportReturnType]


def _primary(run: EvalRun, *, several: bool) -> Primary | None:
    """Of a run: the question that its plan states, else that of its arms; None if it has no placebo."""
    plan, question = run.info.plan, primary(run.info.points)
    arm, placebos = ("", ()) if question is None else (question[0].name, tuple(each.name for each in question[1]))
    if plan is not None:
        arm, placebos = plan.primary, plan.placebos
    pairs = {name: statistics.pairs_of(*matched(run.of_arm(arm), run.of_arm(name))) for name in placebos}
    found = statistics.primary_gain(pairs)
    if found is None:
        return None
    failed = sum(each.failure is not None for each in run.observations)
    unasked = len(run.items) * len(run.info.arms) * run.info.repeats - len(run.observations)
    return Primary(
        name=f"{run.info.mllm}, {arm}" if several else arm,
        placebos=placebos,
        found=found,
        departures=None if plan is None else tuple(departures(run.info, failed, unasked)),
        explored=() if plan is None else tuple(name for name in run.info.arms if name not in plan.arms),
    )


def _splits(name: str, seen: Sequence[Observation], baseline: Sequence[Observation]) -> list[Split]:
    """The gain by known properties of each question's simulation.

    Nothing here may depend on the baseline's replies: groups that are chosen by what is compared differ by themselves.
    """
    errors = sorted(each.path_error for each in seen if each.path_error is not None)
    middle = errors[len(errors) // 2] if errors else 0.0
    groups: dict[tuple[str, str], list[Observation]] = {}
    for each in seen:
        if each.simulation_right is not None:
            groups.setdefault(("simulation", "right" if each.simulation_right else "wrong"), []).append(each)
        if each.path_error is not None:
            by = f"path error ({100 * middle:.1f}% of the width in the middle)"
            groups.setdefault((by, "smaller" if each.path_error < middle else "larger"), []).append(each)
        if each.event_shown is not None:
            reached = "reach the moment" if each.event_shown else "end before the moment"
            groups.setdefault(("frames", reached), []).append(each)
    found = [(*place, statistics.gain(group, baseline)) for place, group in sorted(groups.items())]
    return [Split(name=name, by=by, value=value, gain=gain) for by, value, gain in found if gain is not None]


def baseline_of(runs: Sequence[EvalRun], run: EvalRun) -> list[Observation]:
    """The replies without imagination: of the run itself, else of the first that asked the same of the same model."""
    same = (other for other in runs if other is not run and other.info.baseline_key == run.info.baseline_key)
    return next((seen for each in (run, *same) if (seen := each.of_arm(BASELINE))), [])


def _cells(observations: Sequence[Observation]) -> dict[tuple[str, str | None], Rates]:
    """Per task: all of it, then its levels."""
    cells: dict[tuple[str, str | None], Rates] = {}
    for task, of_task in _by_task(observations).items():
        for level in (None, *sorted({each.level for each in of_task})):
            of_level = statistics.rates([each for each in of_task if level in (None, each.level)])
            if of_level is not None:
                cells[task, level] = of_level
    return cells


def _by_task(observations: Sequence[Observation]) -> dict[Task, list[Observation]]:
    found: dict[Task, list[Observation]] = {
        task: [each for each in observations if each.task == task] for task in TASKS
    }
    return {task: of_task for task, of_task in found.items() if of_task}


def read_prices(path: Path) -> dict[str, Price]:
    """The prices of models, by their names. Raises `InvalidRequest` for a file that is none."""
    try:
        return TypeAdapter(dict[str, Price]).validate_python(yaml.safe_load(path.read_bytes()))
    except OSError as error:
        raise InvalidRequest(f"The prices '{path}' cannot be read: {error.strerror or error}.") from error
    except (yaml.YAMLError, ValidationError) as error:
        raise InvalidRequest(
            f"'{path}' holds no prices: it must look like {{openai/gpt-5: {{input: 1.25, output: 10}}}}, per million "
            f"tokens. {str(error).splitlines()[0]}"
        ) from error
