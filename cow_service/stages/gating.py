"""The gate of `imagine: auto`: the answers from the image alone, which decide whether anything is imagined."""

from __future__ import annotations

from collections import Counter

from cow_service.errors import MllmBadReply
from cow_service.readers.options import read_choices
from cow_service.records import Gate, GateReason
from cow_service.requests import AnswerRequest
from cow_service.stages.answering import ask
from cow_service.stages.results import FirstAnswers, StageResult
from cow_service.stages.run import Run


def ask_first(run: Run[AnswerRequest]) -> StageResult[FirstAnswers]:
    """The answers from the image alone. A reader that gives the same each time is asked once: more votes say no more.

    Raises what the reader raises where it gives no answer, but for a reply that cannot be used: then looking may help.
    """
    request = run.request
    options = read_choices(request.question, request.options)
    votes = 1 if run.repeats_answers(request.imagine_votes) else request.imagine_votes
    try:
        verdict, warnings = ask(run.reader, run.reader_input("gating"), options, None, None, votes)
    except MllmBadReply:
        return StageResult(value=FirstAnswers(verdict=None, asked=votes))
    return StageResult(value=FirstAnswers(verdict=verdict, asked=votes), warnings=warnings)


def gate_of(first: FirstAnswers, threshold: float) -> Gate:
    """Whether to imagine. Votes that could not be read count as asked for: they agree with nothing."""
    verdict = first.verdict
    counts = Counter({} if verdict is None else verdict.votes).most_common(2)
    most = counts[0][1] if counts else 0
    tied = len(counts) > 1 and counts[1][1] == most
    reason: GateReason = "agreed"
    if verdict is None:
        reason = "unreadable"
    elif tied or most / first.asked < threshold:
        reason = "disagreed"
    elif verdict.not_sure:
        reason = "not-sure"
    return Gate(
        answer=None if verdict is None else verdict.answer,
        votes={} if verdict is None else verdict.votes,
        asked=first.asked,
        agreement=most / first.asked,
        threshold=threshold,
        imagined=reason != "agreed",
        reason=reason,
    )
