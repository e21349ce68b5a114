"""What `cow answer` does and shows: the answer, how it came about, and what it cost."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from cow_service.cli.console import (
    console_for,
    make_folder,
    read_request,
    save,
    stages_shown,
    tell,
    tell_warnings,
    writable,
)
from cow_service.cli.options import HINTS
from cow_service.records import Answer, Verdict
from cow_service.requests import AnswerRequest
from cow_service.service import Service


def run_answer(service: Service, image: Path, body: dict[str, Any], out: Path | None, *, as_json: bool) -> None:
    """Answers, showing each stage as it runs, and says what came out; results go into a folder where one is given."""
    console = console_for(as_json)
    if out is not None:
        make_folder(out)
    request, decoded = read_request(service, image, body, AnswerRequest)
    with stages_shown(console) as show:
        answer = service.answer(request, show, decoded)
    written = [] if out is None else _save(service, answer, out)
    if as_json:
        print(answer.model_dump_json(indent=2))
        return
    if answer.simulation is not None:
        tell(console, answer.simulation)
    console.print(_table(answer))
    if answer.reasoning:
        console.print(f"[dim]reasoning[/]: {escape(answer.reasoning)}")
    simulated = () if answer.simulation is None else answer.simulation.warnings
    tell_warnings(console, (*simulated, *answer.warnings))
    for code, hint in HINTS.items():
        if any(f" {code}: " in warning for warning in answer.warnings):
            console.print(hint)
    if out is not None:
        console.print(f"Wrote to [bold]{escape(str(out))}[/]: {', '.join(written)}")


def _save(service: Service, answer: Answer, out: Path) -> list[str]:
    written = [] if answer.simulation is None else save(service, answer.simulation, out)
    with writable(out):
        (out / "answer.json").write_text(answer.model_dump_json(indent=2) + "\n", encoding="utf-8")
    return [*written, "answer.json"]


def _table(answer: Answer) -> Table:
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(style="bold")
    table.add_column()
    table.add_row("answer", _said(answer))
    if sum(answer.votes.values()) > 1:
        table.add_row("votes", _votes(answer))
    if answer.baseline is not None:
        table.add_row("without frames", f"{_said(answer.baseline)}, votes {_votes(answer.baseline)}")
    usage = answer.usage
    asked = f"{usage.calls} calls, {usage.input_tokens} tokens in, {usage.output_tokens} out" if usage.calls else "none"
    table.add_row("tokens", asked)
    table.add_row("time", f"{sum(answer.timings.values()):.2f} s")
    model = answer.reader.model
    table.add_row("reader", escape(answer.reader.name if model is None else f"{answer.reader.name} ({model})"))
    return table


def _said(verdict: Verdict) -> str:
    if verdict.answer is None:
        return "[yellow]not sure[/]"
    text = verdict.answer if verdict.option is None else f"({verdict.answer}) {verdict.option}"
    return f"[yellow]{escape(text)}[/]" if verdict.not_sure else f"[green]{escape(text)}[/]"


def _votes(verdict: Verdict) -> str:
    return ", ".join(f"{escape(name)}: {count}" for name, count in verdict.votes.items())
