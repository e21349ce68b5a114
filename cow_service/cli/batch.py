"""`cow batch`: sends the questions of a file to a server, and writes the outcomes into a folder."""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from cow_service.cli.options import EXISTING, Url, argument, object_in, open_client, option, printable
from cow_service.client import CONCURRENCY
from cow_service.errors import InvalidRequest, StorageUnavailable, Unauthorized

if TYPE_CHECKING:
    from cow_service.client.batches import Question
    from cow_service.client.options import BatchSettings
    from cow_service.records import JobKind

EXIT_SOME_FAILED = 3
EXIT_INTERRUPTED = 130
MAX_FAILURES_SHOWN = 5
MAX_FAULTS_SHOWN = 10
RESUME_HINT = "Run the same command again to resume."


def batch(
    questions: Annotated[
        Path,
        argument(
            'JSON Lines of {"image": FILE or URL, "question": TEXT}; "id", "meta" and request fields are optional.',
            "QUESTIONS",
            readable=True,
            **EXISTING,
        ),
    ],
    out: Annotated[Path, option("Folder for results.jsonl; a batch in it is resumed.", "--out", "-o")],
    kind: Annotated[Literal["answer", "simulate"], option("Whether to answer, or only to simulate.")] = "answer",
    request: Annotated[
        str | None, option('Default request fields, such as {"votes": 5}.', metavar="JSON", shown="none")
    ] = None,
    concurrency: Annotated[int, option("Most questions at the same time.", min=1)] = CONCURRENCY,
    timeout: Annotated[float | None, option("Longest wait for one question, s.", min=0.001, shown="none")] = None,
    save: Annotated[bool, option("Save the pictures of each question in OUT/items.", "--save")] = False,
    fresh: Annotated[bool, option("Compute everything anew instead of using cached results.", "--fresh")] = False,
    minimal: Annotated[bool, option("Leave the long lists out of trajectories.", "--minimal")] = False,
    retry_failed: Annotated[bool, option("Ask failed questions again.", "--retry-failed")] = False,
    url: Url = None,
) -> None:
    """Ask a server many questions; run it again to resume.

    Exit code 0: all succeeded; 3: some failed, with their reasons in results.jsonl; 1: the batch had to stop.
    """
    from cow_service.client.batches import TRANSIENT  # noqa: PLC0415

    asked = _read(questions, object_in(request or "{}", "--request"), kind)
    settings: BatchSettings = {"concurrency": concurrency, "timeout": timeout, "save": save, "out": out}
    settings |= {"fresh": fresh, "minimal": minimal, "retry_failed": retry_failed, "only_new": True, "progress": True}
    try:
        with open_client(url) as client:
            for result in client.map(asked, kind=kind, **settings):
                if result.unsaved is not None:
                    typer.echo(printable(f"{result.id}: not saved: {result.unsaved.detail}"), err=True)
    except KeyboardInterrupt:
        typer.echo(f"Interrupted. {RESUME_HINT} {out / 'results.jsonl'} is complete so far.", err=True)
        sys.stderr.flush()
        os._exit(EXIT_INTERRUPTED)  # do not wait for threads that wait for jobs
    except OSError as error:
        reason = error.strerror or str(error)
        raise StorageUnavailable(f"Cannot write to '{out}': {reason}. {RESUME_HINT}") from error
    except Unauthorized as error:
        error.detail += " `cow batch` sends the key in COW_API_KEY."
        raise
    except TRANSIENT as error:
        error.detail += f" {RESUME_HINT}"
        raise
    raise typer.Exit(print_summary(out))


def _read(path: Path, defaults: dict[str, Any], kind: JobKind) -> list[Question]:
    """The questions of a file. Image paths are relative to the file's folder.

    Raises `InvalidRequest` for anything that the server would refuse, before the first request.
    """
    from pydantic import ValidationError  # noqa: PLC0415

    from cow_service.client.batches import questions  # noqa: PLC0415
    from cow_service.requests import field_errors  # noqa: PLC0415
    from cow_service.requests.flat import REQUESTS  # noqa: PLC0415

    items: list[dict[str, Any]] = []
    faults: list[str] = []
    for number, line in enumerate(path.read_bytes().splitlines(), 1):
        if not line.strip():
            continue
        try:
            item = object_in(line, "it")
            (question,) = questions([item], defaults, path.parent)
            image = dict(question.image) if isinstance(question.image, Mapping) else "data:"
            REQUESTS[kind].model_validate({**question.options, "image": image, "question": question.question})
            items.append(item)
        except ValidationError as error:
            wrong = field_errors(error.errors())[0]
            faults.append(f"{path.name}, line {number}: {wrong.pointer}: {wrong.detail}.")
        except InvalidRequest as error:
            fields = [f"`{field.pointer.rpartition('/')[2]}` {field.detail}." for field in error.errors]
            faults.append(f"{path.name}, line {number}: {' '.join(fields) or error.detail}")
    if faults:
        more = f"\n... and {len(faults) - MAX_FAULTS_SHOWN} more" if len(faults) > MAX_FAULTS_SHOWN else ""
        raise InvalidRequest("\n".join(faults[:MAX_FAULTS_SHOWN]) + more)
    if not items:
        raise InvalidRequest(f"{path.name} holds no questions: write one JSON object per line.")
    return list(questions(items, defaults, path.parent))


def print_summary(out: Path) -> int:
    """Prints a summary of the batch in the folder; returns the exit code."""
    from cow_service.client.display import asked_words  # noqa: PLC0415
    from cow_service.records import Usage  # noqa: PLC0415

    results = out / "results.jsonl"
    codes: Counter[str] = Counter()
    failures: list[str] = []
    count = without_simulation = 0
    usage = total = Usage()
    with results.open("rb") as lines:
        for line in map(json.loads, lines):
            count += 1
            if line["status"] == "succeeded":
                cost = Usage.model_validate(line["result"]["usage"])
                usage += cost
                total += Usage.model_validate(line["result"].get("usage_total", cost))
            without_simulation += "result" in line and line["result"].get("simulation", ...) is None
            if line["status"] == "failed":
                code = line["problem"]["code"]
                codes[code] += 1
                failures.append(f"  {line['id']}: {code}: {line['problem']['detail']}")
    if total.calls:
        typer.echo(f"multimodal LLM: {asked_words(usage, total)}")
    without = f" ({without_simulation} without a simulation)" if without_simulation else ""
    typer.echo(f"{count - len(failures)} succeeded{without}, {len(failures)} failed: {results}")
    if not failures:
        return 0
    typer.echo(", ".join(f"{code} {times}" for code, times in codes.most_common()), err=True)
    for failure in failures[:MAX_FAILURES_SHOWN]:
        typer.echo(printable(failure), err=True)
    if len(failures) > MAX_FAILURES_SHOWN:
        typer.echo(f"  ... and {len(failures) - MAX_FAILURES_SHOWN} more", err=True)
    return EXIT_SOME_FAILED
