"""`cow batch`: a file of questions that is asked to its end, however often it is killed; its words and exit codes."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from sdk import Scripted, address, served, told
from servers import BODY, IMAGE, QUESTION, Served
from typer.testing import CliRunner
from waiting import TIME_LIMIT, eventually

from cow_service.cli.main import app

__all__ = ["address", "served"]  # fixtures

COMMAND = [sys.executable, "-m", "cow_service.cli.main", "batch"]
GIVEN = {name: value for name, value in BODY.items() if name not in ("image", "question")}


def written(folder: Path, count: int, **others: Any) -> Path:
    """A file of questions that differ in their seeds, and the picture that they name in the same folder."""
    (folder / "ball.png").write_bytes(IMAGE)
    asked = {"image": "ball.png", "question": QUESTION, **GIVEN, **others}
    path = folder / "questions.jsonl"
    path.write_text("".join(json.dumps({"id": f"q{n}", **asked, "seed": n}) + "\n" for n in range(count)))
    return path


def lines_of(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]


def batch(*arguments: str | Path, **environment: str) -> Result:
    return CliRunner().invoke(app, ["batch", *map(str, arguments)], env=environment)


@pytest.mark.slow
def test_the_command_tells_by_its_exit_code(address: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    path = written(tmp_path, 5)
    result = batch(path, "-o", out, COW_BASE_URL=address)
    assert result.exit_code == 0, result.stderr
    assert result.stdout == f"5 succeeded, 0 failed: {out / 'results.jsonl'}\n"
    assert len(lines_of(out)) == 5
    gone = {"image": "no.png", "question": "hello", "video": False, "num_frames": 5}
    with path.open("a") as file:
        file.writelines(json.dumps({**gone, "id": f"gone{n}"}) + "\n" for n in range(6))
    for _ in range(2):
        result = batch(path, "-o", out, "--url", address, "--kind", "answer")
        assert result.exit_code == 3
        assert result.stdout.startswith("5 succeeded, 6 failed: ")
        assert "image-unreadable 6" in result.stderr
        assert result.stderr.count(": image-unreadable: ") == 5
        assert "... and 1 more" in result.stderr
    assert len(lines_of(out)) == 11
    (tmp_path / "no.png").write_bytes(IMAGE)
    result = batch(path, "-o", out, "--url", address, "--retry-failed", "--request", '{"imagine": "never"}')
    assert result.exit_code == 1, "what all are asked has changed"
    result = batch(path, "-o", out, "--url", address, "--retry-failed")
    assert result.exit_code == 0, result.stderr
    assert len(lines_of(out)) == 11


ONE = '{"image": "a.png", "question": "?"}'


@pytest.mark.parametrize(
    ("text", "options", "says"),
    [
        ("", (), "questions.jsonl holds"),
        ("{", (), "questions.jsonl, line 1: it is not JSON"),
        ("\n[]", (), "line 2: it must be an object, got list"),
        ('{"image": "a.png", "question": "?", "votes": 99}', (), "line 1: /votes: "),
        (f'{{"question": "?"}}\n\n{ONE[:-1]}, "question": 5}}', (), "line 3: `question` "),
        ('{"image": "a.png", "question": "?", "vote": 1}\n' * 11, (), "... and 1 more"),
        (ONE, ("--request", '{"num_frames": 1}'), "/num_frames"),
        (ONE, ("--request", "[]"), "--request must be an object"),
        (ONE, ("--kind", "simulate", "--request", '{"baseline": true}'), "/baseline"),
    ],
)
def test_a_file_that_cannot_be_asked_is_refused_before_anything_is_sent(
    tmp_path: Path, text: str, options: tuple[str, ...], says: str
) -> None:
    path = tmp_path / "questions.jsonl"
    path.write_text(text)
    result = batch(path, "-o", tmp_path / "out", "--url", "http://127.0.0.1:1", *options)
    assert result.exit_code == 1
    assert says in result.stderr
    assert result.stderr.count("/vote: ") == (10 if "vote" in text and "votes" not in text else 0)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (("--url", "127.0.0.1:8000"), ("invalid-request", "http://")),
        (("--url", "http://127.0.0.1:1"), ("server-unreachable", "Run the same command again")),
        (("--out", "questions.jsonl"), ("storage-unavailable", "'questions.jsonl'")),
        (("--concurrency", "0"), ("--concurrency",)),
    ],
)
def test_what_keeps_a_batch_from_beginning_is_told_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], says: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    path = written(tmp_path, 20)
    result = batch(path, "--out", tmp_path / "out", "--url", "http://127.0.0.1:1", *options)
    assert result.exit_code == (2 if "--concurrency" in options else 1)
    assert isinstance(result.exception, SystemExit)
    assert all(part in result.stderr for part in says)


def test_a_key_that_is_wrong_is_said_to_be_that_of_the_environment(tmp_path: Path) -> None:
    with Scripted(told("unauthorized", 401)) as server:
        result = batch(written(tmp_path, 1), "--out", tmp_path / "out", "--url", server.url)
    assert result.exit_code == 1
    assert result.stderr.startswith("unauthorized")
    assert "COW_API_KEY" in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_what_ends_it_loses_nothing(tmp_path: Path, served: Served, address: str, number: signal.Signals) -> None:
    slow = {"generator": "slow", "generator_options": {"seconds": 200.0}, "num_frames": 80, "frames": {"count": 40}}
    path = written(tmp_path, 3, **slow, question=f"Will it be ended by {number}?")
    arguments = (str(path), "-o", str(tmp_path / "out"), "--url", address)

    def jobs() -> list[str]:
        listed = served.http.get("/jobs").json()["jobs"]
        return [job["id"] for job in listed if job["status"] in ("queued", "running")]

    with subprocess.Popen([*COMMAND, *arguments], stderr=subprocess.PIPE, text=True) as process:
        eventually(lambda: len(jobs()) == 3)
        process.send_signal(number)
        _, said = process.communicate(timeout=TIME_LIMIT)  # no job ends within it
    if number == signal.SIGINT:
        assert process.returncode == 130
        assert "again to resume" in said
        assert "Traceback" not in said
    asked = jobs()
    assert len(asked) == 3
    for job in asked:
        served.http.post(f"/jobs/{job}/cancel").raise_for_status()
    again = batch(*arguments)
    assert again.exit_code == 3
    assert "canceled 3" in again.stderr, "it found the jobs of the first time"
    assert served.http.get("/jobs").json()["jobs"][0]["id"] in asked
