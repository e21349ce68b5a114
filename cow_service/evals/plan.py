"""What a run is, on record; and the analysis that is fixed before it: the primary question, its test, its size."""

import hashlib
import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError

from cow_service.errors import InvalidRequest
from cow_service.evals.design import GATE_VOTES, Arm, Order, primary
from cow_service.evals.items import Ask
from cow_service.evals.statistics import ALPHA, POWER, Cost, effect_shown, power_of, scenes_needed
from cow_service.records import Record
from cow_service.records.grounding import Sha256

FORMAT: Literal[2] = 2
DISCORDANT = 0.2  # share of pairs of replies with exactly one right, without a pilot
_OF_DESIGN = {"data_digest", "mllm", "ask", "arms", "repeats", "order", "seed", "options"}
METHOD = (
    "The difference in the share of right replies between the primary arm and each placebo with the same frames and "
    "votes, paired by question and repeat. Two-sided permutation test of the signs of whole scenes; p is the largest "
    "of the placebos' where the gains have one sign, else 1. 95% interval with scenes as clusters: its lower end is "
    "the lowest of the placebos', its upper end the lowest of theirs at an error of 5% divided by their number. All "
    "contrasts of the plan are adjusted together (Holm). An unreadable reply is not right; a question without a reply "
    "in one of the two arms, or with frames in one alone, counts in neither."
)


class RunRecord(Record):
    """What decides the replies of a run."""

    data: str = Field(description="As it was given.")
    data_digest: Sha256 = Field(description="Of the items, their pictures and truths included.")
    scenes: int = Field(default=0, description="Clusters of items.")
    counts: dict[str, int] = Field(description="Items by task and level: `collision L1`.")
    mllm: str = Field(description="Who answered, as Inspect names it, or `cow/embedded`.")
    ask: Ask
    arms: dict[str, dict[str, Any]] = Field(description="The factors of each arm, by its name.")
    repeats: int = Field(ge=1)
    order: Order = Field(default="shuffled", description="Of the options.")
    seed: int
    options: dict[str, Any] = Field(description="As they were given: the names of the command line's options.")
    versions: dict[str, str] = Field(description="Of this service, its commit, the packages and prompts.")
    created_at: str = Field(description="RFC 3339, UTC.")

    @property
    def design_digest(self) -> str:
        """Of all that decides the replies but the versions of the packages."""
        prompts = {name: value for name, value in self.versions.items() if name.startswith("prompts/")}
        fixed = self.model_dump(mode="json", include=_OF_DESIGN) | prompts
        return hashlib.sha256(json.dumps(fixed, sort_keys=True).encode()).hexdigest()

    @property
    def points(self) -> tuple[Arm, ...]:
        """The arms."""
        return tuple(map(Arm.model_validate, self.arms.values()))


class AnalysisPlan(RunRecord):
    """What is to be asked and how it is to be analysed, written before the first question is."""

    format: Literal[2] = FORMAT
    primary: str = Field(description="The arm whose gain is the primary question.")
    placebos: tuple[str, ...] = Field(description="The arms that it must beat, each of them.")
    method: str = METHOD
    alpha: float = ALPHA
    effect: float = Field(description="The gain that is hoped for, as a share of questions.")
    variance: float = Field(description="Of the scenes' mean differences: assumed, or an upper bound by a pilot run.")
    pilot: str | None = Field(default=None, description="Digest of the pilot's design, and how many scenes it had.")
    scenes_needed: int = Field(description=f"For that gain over each placebo, with a power of {POWER:.0%}.")
    power: float = Field(description="Of the scenes that there are, at least.")


class RunInfo(RunRecord):
    """What a folder of results was asked: as much as it takes to ask the same again."""

    format: Literal[2] = FORMAT
    faults: tuple[str, ...] = Field(default=(), description="Rows that were left out, and why.")
    notes: tuple[str, ...] = Field(default=(), description="What was found in the data and worked around, with counts.")
    rounds: int = Field(default=0, description="How often what had failed was asked again.")
    token: str = Field(default="", description="Random: names the requests and replies of the run.")
    plan: AnalysisPlan | None = Field(default=None, description="The analysis that was fixed before the run.")
    replied_as: tuple[str, ...] = Field(default=(), description="Models, dated if they are, by their provider's names.")

    @property
    def baseline_key(self) -> tuple[Any, ...]:
        """What two runs have in common whose replies may be compared."""
        deciding = ("mllm_revision", "base_url", "temperature", "max_tokens")
        generation = tuple(self.options.get(name) for name in deciding)
        return self.data_digest, self.mllm, self.ask, self.seed, self.order, generation


def differences(before: RunRecord, now: RunRecord) -> list[str]:
    """What decides replies and is not the same, each by the name of its option."""
    names = dict.fromkeys((*before.options, *now.options))
    found = [
        f"--{name.replace('_', '-')} {before.options.get(name)}, not {now.options.get(name)}"
        for name in names
        # Where the data lies does not matter; what it holds does.
        if name != "data" and before.options.get(name) != now.options.get(name)
    ]
    if before.data_digest != now.data_digest:
        counts = f"{sum(before.counts.values())} of them, not {sum(now.counts.values())}"
        found.append(f"the questions, pictures or truths of '{now.data}' ({counts})")
    if before.mllm != now.mllm and not found:
        found.append(f"the multimodal LLM {before.mllm}, not {now.mllm}")
    prompts = sorted(name for name in now.versions if name.startswith("prompts/"))
    return found + [
        f"the text of {name} (version {before.versions.get(name)}, not {now.versions[name]})"
        for name in prompts
        if before.versions.get(name) != now.versions[name]
    ]


def departures(run: RunInfo, failed: int, unasked: int) -> list[str]:
    """Departures of a run from its plan, in words, given the numbers of failed questions and of those not asked yet."""
    plan = run.plan
    if plan is None:
        return []
    found = differences(plan, run)
    missing = [name for name in plan.arms if name not in run.arms]
    found += [f"arms that were planned and not asked: {', '.join(missing)}"] if missing else []
    found += [f"--repeats {plan.repeats}, not {run.repeats}"] if plan.repeats != run.repeats else []
    found += [f"{failed} questions failed"] if failed else []
    found += [f"{unasked} questions were not asked yet"] if unasked else []
    for name in ("cow-service", "commit"):
        if plan.versions.get(name) != run.versions.get(name):
            found.append(f"{name} {plan.versions.get(name)}, not {run.versions.get(name)}")
    return found


def planned(info: RunInfo, effect: float, variance: float = DISCORDANT, pilot: str | None = None) -> AnalysisPlan:
    """The plan of a run with these options. Raises `InvalidRequest` for one without a primary question."""
    question = primary(info.points)
    if question is None:
        raise InvalidRequest(
            "A plan needs a primary question: an arm of simulated frames, such as always, and a placebo with the same "
            "frames and votes, such as placebo-still."
        )
    arm, placebos = question
    return AnalysisPlan(
        **info.model_dump(include=set(RunRecord.model_fields) - {"created_at"}),
        created_at=datetime.now(UTC).isoformat(timespec="seconds"),
        primary=arm.name,
        placebos=tuple(each.name for each in placebos),
        effect=effect,
        variance=variance,
        pilot=pilot,
        scenes_needed=scenes_needed(effect, variance, len(placebos)),
        power=power_of(effect, variance, info.scenes, len(placebos)),
    )


def read_plan(path: Path) -> AnalysisPlan:
    """A plan that `cow eval plan` wrote. Raises `InvalidRequest` for a file that is none."""
    try:
        return AnalysisPlan.model_validate_json(path.read_bytes())
    except OSError as error:
        raise InvalidRequest(f"The plan '{path}' cannot be read: {error.strerror or error}.") from error
    except ValidationError as error:
        raise InvalidRequest(
            f"'{path}' is not a plan of this version's `cow eval plan`: {str(error).splitlines()[-2].strip()}"
        ) from error


def describe(plan: AnalysisPlan, costs: Mapping[str, Cost]) -> str:
    """The plan in words: the primary question, the scenes it needs, and its cost.

    `costs` are those of a pilot's arms by name, where there was one.
    """
    items, points = sum(plan.counts.values()), f"{100 * plan.effect:g} points"
    shown = 100 * effect_shown(max(plan.scenes, 1), plan.variance, len(plan.placebos))
    lines = [
        f"Primary question: does {plan.primary} gain over {' and over '.join(plan.placebos)}?",
        f"{plan.scenes_needed:,} scenes show a gain of {points} over each, with a power of {POWER:.0%} or more "
        f"(variance of scenes {plan.variance:.3f}). There are {plan.scenes:,}: a power of {plan.power:.0%} or more, or "
        f"of {POWER:.0%} for a gain of {shown:.1f} points.",
    ]
    calls, pictures, simulations = size_of_run(plan)
    lines.append(
        f"{items:,} questions in {len(plan.arms)} arms, asked {plan.repeats} times: at most {calls:,} calls with "
        f"{pictures:,} pictures, and {simulations:,} simulations."
    )
    replies = items * plan.repeats
    known = {name: (costs[name], replies / costs[name].replies) for name in plan.arms if name in costs}
    if known:
        tokens = sum((cost.input_tokens + cost.output_tokens) * more for cost, more in known.values())
        hours = sum(cost.seconds * more for cost, more in known.values()) / 3600
        money = sum((cost.money or 0.0) * more for cost, more in known.values())
        paid = f", {money:,.2f} in the currency of the prices" if money else ""
        unknown = [name for name in plan.arms if name not in costs]
        lines.append(
            f"By the pilot {tokens:,.0f} tokens and {hours:,.1f} hours, one call after another{paid}"
            + (f"; without {', '.join(unknown)}, which the pilot did not ask." if unknown else ".")
        )
    return "\n".join(lines)


def size_of_run(plan: AnalysisPlan) -> tuple[int, int, int]:
    """The most calls, pictures sent with them, and simulations that the run takes."""
    replies = sum(plan.counts.values()) * plan.repeats
    simulations: set[Any] = set()
    calls = pictures = 0
    for arm in plan.points:
        asked = arm.votes + (GATE_VOTES if arm.gate else 0)
        calls += asked * replies
        pictures += (asked * arm.image + arm.votes * arm.count * arm.shows_frames) * replies
        for trial in range(arm.votes if arm.content != "none" else 0):
            frames = tuple(arm.frames_request.values()) if arm.shows_frames else ()
            simulations |= {(frames, trial)}
            if arm.content in ("wrong-direction", "true"):
                simulations |= {(frames, trial, arm.content)}
    return calls, pictures, len(simulations) * replies // plan.repeats
