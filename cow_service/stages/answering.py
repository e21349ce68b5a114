"""Stage 5: the answer, drawn from the image and the frames of its imagined future."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from cow_service.errors import CowError, MllmBadReply
from cow_service.media.artifacts import ArtifactStore
from cow_service.media.images import decode_own
from cow_service.readers.base import AnswerReading, Imagined, Look
from cow_service.records import AnswerOption, Simulation, Verdict

NOT_SURE = "not sure"  # the name of that vote where no option says so


def answer(
    look: Look, options: Sequence[AnswerOption], imagined: Imagined | None, votes: int
) -> tuple[Verdict, tuple[str, ...]]:
    """The most frequent of `votes` answers, of several equally frequent ones the first that was given; and warnings.

    Raises what the reader raises where it gives none at all.
    """
    readings = look.answer(options, imagined, votes)
    counted = Counter(_named(reading) for reading in readings)
    most = max(counted.values())
    winner = next(reading for reading in readings if counted[_named(reading)] == most)
    option = next((option.text for option in options if option.letter == winner.answer), None)
    verdict = Verdict(
        answer=winner.answer,
        option=option,
        not_sure=winner.not_sure,
        reasoning=winner.reasoning,
        votes=dict(counted),
    )
    return verdict, (*winner.notes, *_split(verdict, votes))


def baseline(look: Look, options: Sequence[AnswerOption], votes: int) -> Verdict | CowError:
    """The answer from the image alone, for comparison, or the error that it came to."""
    try:
        return answer(look, options, None, votes)[0]
    except MllmBadReply as error:
        return error


def frames_of(simulation: Simulation, artifacts: ArtifactStore) -> Imagined:
    """A simulation with the pixels of its chosen frames."""
    return Imagined(simulation, tuple(decode_own(artifacts.read(frame.sha256)) for frame in simulation.frames))


def _split(verdict: Verdict, votes: int) -> tuple[str, ...]:
    """What a caller should know of the votes, in whole sentences; empty where there is nothing to say."""
    found: list[str] = []
    lost = votes - sum(verdict.votes.values())
    if lost:
        found.append(f"{lost} of {votes} votes could not be read and do not count.")
    most = max(verdict.votes.values())
    tied = [name for name, count in verdict.votes.items() if count == most]
    if len(tied) > 1:
        found.append(f"The votes are tied between {' and '.join(tied)}; the first one given was taken.")
    return tuple(found)


def _named(reading: AnswerReading) -> str:
    return reading.answer or NOT_SURE
