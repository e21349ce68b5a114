"""What `models()` returns: the server's readers and generators, as a table in a notebook and in a terminal."""

from __future__ import annotations

from html import escape

from cow_service import records
from cow_service.client.display import DIM_STYLE, TEXT_STYLE, one_line
from cow_service.client.wording import readiness_words
from cow_service.records import BackendInfo

HEADINGS = ("role", "name", "ready", "licence", "weights", "to make it ready")
# Words break only where they are wider than their column: else those of narrow columns would.
_CELL = "padding:3px 14px 3px 0;text-align:left;vertical-align:top;overflow-wrap:break-word"


class Models(records.Models):
    """Readers and generators, what each needs, and whether it is ready.

    >>> [generator.name for generator in client.models().generators if generator.default]
    ['cutout']
    """

    def __repr__(self) -> str:
        rows = [
            (role, _name(backend), one_line("; ".join((readiness_words(backend), *_commands(backend)))))
            for role, backend in self._backends()
        ]
        widths = [max((len(row[column]) for row in rows), default=0) for column in (0, 1)]
        return "\n".join(f"{role:<{widths[0]}}  {name:<{widths[1]}}  {said}" for role, name, said in rows)

    __str__ = __repr__

    def _repr_html_(self) -> str:
        head = "".join(f'<th style="{_CELL}">{heading}</th>' for heading in HEADINGS)
        rows = "".join(f"<tr>{_cells(role, backend)}</tr>" for role, backend in self._backends())
        table = f'<table style="border-collapse:collapse"><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>'
        table = f'<div style="overflow-x:auto">{table}</div>'
        named = escape(", ".join(self.mllms)) or "none"
        return f'<div style="{TEXT_STYLE}">{table}<div style="{DIM_STYLE}">COW_MLLM may name: {named}</div></div>'

    def _backends(self) -> list[tuple[str, BackendInfo]]:
        readers = [("reader", backend) for backend in self.readers]
        return readers + [("generator", backend) for backend in self.generators]


def _name(backend: BackendInfo) -> str:
    return one_line(backend.name) + (" (default)" if backend.default else "")


def _commands(backend: BackendInfo) -> tuple[str, ...]:
    """The commands that bring what is missing."""
    return tuple(filter(None, (backend.install, backend.pull)))


def _cells(role: str, backend: BackendInfo) -> str:
    name = f'<b>{escape(_name(backend))}</b><div style="{DIM_STYLE}">{escape(backend.summary)}</div>'
    commands = "".join(f"<div><code>{escape(command)}</code></div>" for command in _commands(backend))
    said = escape(readiness_words(backend)), escape(backend.licence or ""), escape(backend.weights or "none")
    return "".join(f'<td style="{_CELL}">{cell}</td>' for cell in (role, name, *said, commands))
