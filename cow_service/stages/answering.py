"""Stage 5: the answer, drawn from the image and the frames of its imagined future."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from cow_service.errors import MllmBadReply
from cow_service.media.images import decode_own
from cow_service.readers.base import AnswerReading, Imagined, Reader, ReaderInput
from cow_service.readers.options import read_choices
from cow_service.records import AnswerOption, Gate, GateReason, Grounding, Simulation, Stage, Verdict
from cow_service.requests import AnswerRequest
from cow_service.stages.keys import FirstAnswers, StageResult
from cow_service.stages.run import Run

NOT_SURE = "not sure"  # the name of that vote where no option says so


def answer_question(
    run: Run[AnswerRequest], grounding: Grounding | None, simulation: Simulation | None
) -> StageResult[Verdict]:
    """The answer after looking at a simulation, or from the image alone. Raises what the reader raises."""
    request = run.request
    options = read_choices(request.question, request.options)
    given = run.reader_input("answering")
    imagined = None
    if simulation is not None:
        with run.cpu():
            frames, factual = (
                tuple(decode_own(run.backends.artifacts.read(frame.sha256)) for frame in chosen)
                for chosen in (simulation.frames, simulation.factual_frames)
            )
            imagined = Imagined(simulation, frames, factual)
    verdict, warnings = ask(run.reader, given, options, grounding, imagined, request.votes)
    return StageResult(value=verdict, warnings=warnings)


def ask(
    reader: Reader,
    given: ReaderInput,
    options: Sequence[AnswerOption],
    grounding: Grounding | None,
    imagined: Imagined | None,
    votes: int,
) -> tuple[Verdict, tuple[str, ...]]:
    """The most frequent of `votes` answers, of several equally frequent ones the first that was given; and warnings."""
    readings = reader.answer(given, options, grounding, imagined, votes)
    counted = Counter(_named(reading) for reading in readings)
    most = max(counted.values())
    winner = next(reading for reading in readings if counted[_named(reading)] == most)
    verdict = Verdict(
        answer=winner.answer,
        option=next((option.text for option in options if option.letter == winner.answer), None),
        not_sure=winner.not_sure,
        reasoning=winner.reasoning,
        votes=dict(counted),
    )
    warnings, lost = list(winner.notes), votes - len(readings)
    if lost:
        warnings.append(f"{lost} of {votes} votes could not be read and were not counted.")
    tied = [name for name, count in counted.items() if count == most]
    if len(tied) > 1:
        warnings.append(f"The votes are tied between {' and '.join(tied)}; the first one was taken.")
    return verdict, tuple(warnings)


def _named(reading: AnswerReading) -> str:
    return reading.answer or NOT_SURE


def ask_first(run: Run[AnswerRequest]) -> StageResult[FirstAnswers]:
    """The answers of the gate. A reader that gives the same each time is asked once: more votes say no more."""
    votes = run.request.imagine_votes
    return ask_baseline(run, "gating", 1 if run.repeats_answers(votes) else votes)


def ask_baseline(
    run: Run[AnswerRequest], stage: Stage = "baseline", votes: int | None = None
) -> StageResult[FirstAnswers]:
    """The answers from the image alone; no verdict where no reply can be used. Raises what else the reader raises."""
    request = run.request
    options, votes = read_choices(request.question, request.options), votes or request.votes
    # Not the language that the grounding finds: it may be at work meanwhile.
    given = replace(run.reader_input(stage), language=request.language or "en")
    try:
        verdict, warnings = ask(run.reader, given, options, None, None, votes)
    except MllmBadReply as error:
        warning = f"There is no baseline answer: {error.detail}"
        warnings = (warning,) if stage == "baseline" else ()
        return StageResult(value=FirstAnswers(verdict=None, asked=votes), warnings=warnings)
    return StageResult(value=FirstAnswers(verdict=verdict, asked=votes), warnings=warnings)


def gate_of(first: FirstAnswers, threshold: float) -> Gate:
    """Whether to imagine. Votes that could not be read count as asked for: they agree with nothing."""
    verdict = first.verdict
    votes = {} if verdict is None else verdict.votes
    second, most = sorted([0, 0, *votes.values()])[-2:]
    reason: GateReason = "agreed"
    if verdict is None:
        reason = "unreadable"
    elif most == second or most / first.asked < threshold:
        reason = "disagreed"
    elif verdict.not_sure:
        reason = "not-sure"
    return Gate(
        answer=None if verdict is None else verdict.answer,
        votes=votes,
        asked=first.asked,
        agreement=most / first.asked,
        threshold=threshold,
        imagined=reason != "agreed",
        reason=reason,
    )
