"""Loads prompts: a Markdown file each, with YAML front matter and a Jinja2 body.

What a prompt is given is data: it is put in as it stands, and never read as a template.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import yaml
from jinja2 import StrictUndefined, Template
from jinja2.meta import find_undeclared_variables
from jinja2.sandbox import ImmutableSandboxedEnvironment

from cow_service.weights.manifests import PROMPTS

FIELDS = {"version": int, "inputs": list}
_FENCE = "---"

# No autoescape: prompts are plain text for a model, and HTML entities would change the words it reads.
_ENVIRONMENT = ImmutableSandboxedEnvironment(autoescape=False, undefined=StrictUndefined, trim_blocks=True)


@dataclass(frozen=True)
class Prompt:
    """A prompt with its declared inputs. It does not call a model."""

    name: str
    version: int
    inputs: tuple[str, ...]
    body: str

    def render(self, /, **inputs: object) -> str:
        """The prompt with its inputs put in. Raises `TypeError`, naming inputs that are missing or not declared."""
        missing = [name for name in self.inputs if name not in inputs]
        unknown = [name for name in inputs if name not in self.inputs]
        if missing or unknown:
            faults = {"missing": missing, "not declared": unknown}
            problems = [f"{what}: {', '.join(names)}" for what, names in faults.items() if names]
            raise TypeError(f"Prompt {self.name!r}, inputs {'; '.join(problems)}.")
        return _compiled(self.body).render(**inputs).strip()


@cache
def _compiled(body: str) -> Template:
    return _ENVIRONMENT.from_string(body)  # which takes milliseconds


@cache
def load_prompt(name: str) -> Prompt:
    """A shipped prompt. Raises `LookupError` where there is none, `ValueError` where its file is not well formed."""
    return parse_prompt(name, PROMPTS.read(name))


def parse_prompt(name: str, text: str) -> Prompt:
    """A prompt from its file's text. Raises `ValueError`, naming the prompt and what is wrong with it."""
    lines = text.splitlines()
    if not lines or lines[0].strip() != _FENCE or _FENCE not in (line.strip() for line in lines[1:]):
        raise ValueError(f"Prompt {name!r} does not begin with front matter between two lines of {_FENCE!r}.")
    end = next(at for at, line in enumerate(lines[1:], 1) if line.strip() == _FENCE)
    head: Any = yaml.safe_load("\n".join(lines[1:end]))
    _check(name, head)
    body = "\n".join(lines[end + 1 :]).strip()
    inputs = tuple(str(item) for item in head["inputs"])
    undeclared = find_undeclared_variables(_ENVIRONMENT.parse(body)) - set(inputs)
    if undeclared:
        raise ValueError(f"Prompt {name!r} uses inputs that it does not declare: {', '.join(sorted(undeclared))}.")
    return Prompt(name, head["version"], inputs, body)


def _check(name: str, head: Any) -> None:
    if not isinstance(head, dict) or set(head) != set(FIELDS):
        raise ValueError(f"Prompt {name!r} needs exactly these fields in its front matter: {', '.join(FIELDS)}.")
    for field, kind in FIELDS.items():
        if not isinstance(head[field], kind) or isinstance(head[field], bool):
            raise ValueError(f"Prompt {name!r}: {field} must be of type {kind.__name__}, not {head[field]!r}.")
