"""Results as text, for models and for clients that do not read structured content."""

from __future__ import annotations

from collections.abc import Iterable

from cow_service.client.wording import gate_words, worlds
from cow_service.mcp.results import AnswerResult, Encounter, SimulateResult, Verdict
from cow_service.records import MEETINGS


def simulation_text(simulation: SimulateResult) -> str:
    """What moves, how, what it meets when; which picture is which; what to mind."""
    return "\n".join([*_simulation(simulation), *_warnings(simulation.warnings), _image_hint(simulation.image_sha256)])


def answer_text(answer: AnswerResult) -> str:
    """The answer first, then what was imagined for it."""
    lines = [f"Answer: {_verdict(answer.answer, answer.option)}."]
    if answer.reasoning:
        lines.append(f"Reasoning: {answer.reasoning}")
    if sum(answer.votes.values()) > 1:
        lines.append(f"Votes: {_votes(answer.votes)}.")
    if answer.gate is not None:
        lines.append(f"Before looking: {gate_words(answer.gate)}.")
    if answer.baseline is not None:
        lines.append(f"Without imagined frames: {_baseline(answer.baseline)}.")
    warnings = list(answer.warnings)
    if answer.simulation is not None:
        lines += ["", "Imagined:", *_simulation(answer.simulation)]
        warnings += answer.simulation.warnings
    else:
        lines.append("Nothing was imagined: the answer is from the image alone.")
    return "\n".join([*lines, *_warnings(warnings), _image_hint(answer.image_sha256)])


def _simulation(simulation: SimulateResult) -> Iterable[str]:
    box = ", ".join(f"{side:g}" for side in simulation.bbox)
    size = f"{simulation.image_width} x {simulation.image_height} px"
    yield simulation.motion
    yield f"It is the {simulation.object} at [{box}] in the image of {size}; {_motion(simulation)}."
    yield _encounters(simulation)
    if simulation.contacts:
        yield f"Contacts: {'; '.join(f'{one.a} and {one.b} at {one.time_s:g} s' for one in simulation.contacts)}."
    if simulation.outcome is not None and simulation.outcome.summary:
        yield f"Outcome (a hypothesis of the simulated world): {simulation.outcome.summary}."
    if simulation.moving_until_s is not None:
        yield f"Nothing moves in the image from {simulation.moving_until_s:g} s on."
    if simulation.leaves_at_s is not None:
        yield f"Its centre leaves the image at {simulation.leaves_at_s:g} s."
    frames = [f"frame {frame.index} ({frame.time_s:g} s)" for frame in simulation.frames]
    yield f"Pictures, in this order: the image with box, direction and path drawn; {', '.join(frames)}."
    if simulation.video is not None:
        yield f"Video: {simulation.video.url or simulation.video.uri}"
    yield f"Simulation {simulation.id}; generator {simulation.generator}, reader {simulation.reader}."


def _motion(simulation: SimulateResult) -> str:
    if simulation.direction is None:
        return f"{simulation.kind}, law {simulation.law}"
    along = ", ".join(f"{part:g}" for part in simulation.direction)
    return f"{simulation.kind}, direction [{along}] (x right, y down), {simulation.speed:g} px/s, law {simulation.law}"


def _encounters(simulation: SimulateResult) -> str:
    encounters = "; ".join(_encounter(encounter) for encounter in simulation.encounters)
    if encounters:
        return f"On its way (hypotheses) it {encounters}."
    if simulation.encounters_known:
        return "It meets nothing on its way, as far as the image tells."
    return "What it meets was not computed."


def _encounter(encounter: Encounter) -> str:
    sure = "" if encounter.probability is None else f", {worlds(encounter.probability)}"
    return f"{MEETINGS[encounter.kind]} {encounter.object} from {encounter.time_s:g} s (frame {encounter.frame}{sure})"


def _verdict(answer: str | None, option: str | None) -> str:
    if answer is None:
        return "not sure"
    return answer if option is None else f"{answer} ({option})"


def _baseline(baseline: Verdict) -> str:
    verdict = _verdict(baseline.answer, baseline.option)
    return f"{verdict}; votes {_votes(baseline.votes)}" if sum(baseline.votes.values()) > 1 else verdict


def _votes(votes: dict[str, int]) -> str:
    return ", ".join(f"{answer}: {count}" for answer, count in votes.items())


def _warnings(warnings: Iterable[str]) -> Iterable[str]:
    return (f"Note: {warning}" for warning in dict.fromkeys(warnings))


def _image_hint(sha256: str) -> str:
    return f'To ask about this image again, give image="{sha256}".'
