"""`cow batch`: a file of questions, asked of a server, into a folder of outcomes."""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from cow_service.errors import CowError, FieldError, InvalidRequest

SOME_FAILED = 3
INTERRUPTED = 130
SHOWN_FAILURES = 5


class BatchKind(StrEnum):
    """What each question asks for."""

    answer = "answer"
    simulate = "simulate"


def batch(
    questions: Annotated[
        Path,
        typer.Argument(
            metavar="QUESTIONS",
            help='JSON Lines: {"image": FILE or URL, "question": TEXT}, maybe "id", "meta", and fields of the request.',
            exists=True,
            dir_okay=False,
            readable=True,
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for results.jsonl; a batch in it is gone on with.")],
    kind: Annotated[BatchKind, typer.Option(help="Whether to answer, or only to simulate.")] = BatchKind.answer,
    request: Annotated[
        str | None,
        typer.Option(metavar="JSON", help='Fields for questions that lack them: {"votes": 5}.', show_default="none"),
    ] = None,
    concurrency: Annotated[int, typer.Option(min=1, help="Questions at the same time.")] = 8,
    timeout: Annotated[
        float | None, typer.Option(min=0.001, help="Longest wait for one question, s.", show_default="none")
    ] = None,
    save: Annotated[bool, typer.Option("--save", help="Keep the pictures of each in OUT/items.")] = False,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Ask those again that failed.")] = False,
    url: Annotated[
        str | None, typer.Option(help="The server.", show_default="COW_BASE_URL, http://127.0.0.1:8000")
    ] = None,
) -> None:
    """Ask many questions of a server; the same command goes on where it was killed.

    Exit code 0: all succeeded; 3: some failed, with their reasons in results.jsonl; 1: the batch could not go on.
    """
    asked = _read(questions)
    defaults = _defaults(request)
    _check(asked, defaults, kind)
    try:
        _ask(asked, defaults, out, kind, url, concurrency, timeout, save, retry_failed)
    except KeyboardInterrupt:
        typer.echo(f"Interrupted. The same command goes on with it; {out / 'results.jsonl'} is whole.", err=True)
        sys.stderr.flush()
        os._exit(INTERRUPTED)  # threads that wait for jobs are not waited for
    except OSError as error:
        told = error.strerror or str(error)
        raise CowError(f"'{out}' cannot be written: {told}. The same command goes on with the batch.") from error
    except CowError as error:
        error.detail += " The same command goes on with the batch."
        raise
    raise typer.Exit(_tell(out))


def _ask(
    asked: list[dict[str, Any]],
    defaults: dict[str, Any],
    out: Path,
    kind: BatchKind,
    url: str | None,
    concurrency: int,
    timeout: float | None,
    save: bool,
    retry_failed: bool,
) -> None:
    from cow_service.client import Client  # noqa: PLC0415

    with Client(url) as client:
        outcomes = client.map(
            asked,
            kind=kind.value,  # pyright: ignore[reportArgumentType] - one of the two
            concurrency=concurrency,
            out=out,
            retry_failed=retry_failed,
            only_new=True,
            save=save,
            timeout=timeout,
            progress=True,
            **defaults,
        )
        for _ in outcomes:
            pass


def _read(path: Path) -> list[dict[str, Any]]:
    """The questions of a file; images are looked for beside it. Raises `InvalidRequest` with the line."""
    asked: list[dict[str, Any]] = []
    for number, line in enumerate(path.read_bytes().splitlines(), 1):
        if not line.strip():
            continue
        try:
            item = json.loads(line)
        except ValueError as error:
            raise InvalidRequest(f"{path.name}, line {number}: no JSON: {error}.") from error
        if not isinstance(item, dict):
            raise InvalidRequest(f"{path.name}, line {number}: must be an object, got {type(item).__name__}.")
        image = item.get("image")
        if isinstance(image, str) and not image.startswith(("data:", "http://", "https://")):
            item["image"] = str(path.parent / image)
        asked.append(item)
    if not asked:
        raise InvalidRequest(f"{path.name} holds no questions: give one JSON object a line.")
    return asked


def _defaults(text: str | None) -> dict[str, Any]:
    try:
        given = json.loads(text or "{}")
    except ValueError as error:
        raise InvalidRequest(f"--request is no JSON: {error}.") from error
    if not isinstance(given, dict):
        raise InvalidRequest(f"--request must be an object, got {type(given).__name__}.")
    return given


def _check(asked: list[dict[str, Any]], defaults: dict[str, Any], kind: BatchKind) -> None:
    """Raises `InvalidRequest` for whatever the server would refuse, before it is asked anything."""
    from pydantic import ValidationError  # noqa: PLC0415

    from cow_service.client.questions import questions  # noqa: PLC0415
    from cow_service.requests import AnswerRequest, SimulateRequest  # noqa: PLC0415

    model = AnswerRequest if kind is BatchKind.answer else SimulateRequest
    for place, question in enumerate(questions(asked, defaults), 1):
        try:
            model.model_validate({"image": "data:", "question": question.question, **question.options})
        except ValidationError as error:
            wrong = error.errors()[0]
            pointer = "/" + "/".join(str(part) for part in wrong["loc"])
            raise InvalidRequest(
                f"Question {place} ('{question.id}'): {pointer}: {wrong['msg']}.",
                errors=(FieldError(pointer, wrong["msg"]),),
            ) from error


def _tell(out: Path) -> int:
    """Says what the folder holds of the batch; returns the exit code."""
    results = out / "results.jsonl"
    codes: Counter[str] = Counter()
    failures: list[str] = []
    count = 0
    with results.open("rb") as lines:
        for line in map(json.loads, lines):
            count += 1
            if line["status"] == "failed":
                code = line["problem"]["type"].rpartition(":")[2]
                codes[code] += 1
                failures.append(f"  {line['id']}: {code}: {line['problem']['detail']}")
    typer.echo(f"{count - len(failures)} succeeded, {len(failures)} failed: {results}")
    if not failures:
        return 0
    typer.echo(", ".join(f"{code} {times}" for code, times in codes.most_common()), err=True)
    for told in failures[:SHOWN_FAILURES]:
        typer.echo(told, err=True)
    if len(failures) > SHOWN_FAILURES:
        typer.echo(f"  ... and {len(failures) - SHOWN_FAILURES} more", err=True)
    return SOME_FAILED
