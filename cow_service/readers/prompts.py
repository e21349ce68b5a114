"""Loads prompts: a Markdown file each, with YAML front matter and a Jinja2 body.

What a prompt is given is data: it is put in as it stands, and never read as a template.
"""

import re
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import yaml
from jinja2 import StrictUndefined, Template
from jinja2.meta import find_undeclared_variables
from jinja2.sandbox import ImmutableSandboxedEnvironment

from cow_service.weights.manifests import PROMPTS

FIELDS = {"version": int, "inputs": list}

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
        return self.template.render(**inputs).strip()

    @cached_property
    def template(self) -> Template:
        """Its body, compiled, which takes milliseconds."""
        return _ENVIRONMENT.from_string(self.body)


@cache
def load_prompt(name: str) -> Prompt:
    """A shipped prompt. Raises `LookupError` where there is none, `ValueError` where its file is not well formed."""
    return parse_prompt(name, PROMPTS.read(name))


def parse_prompt(name: str, text: str) -> Prompt:
    """A prompt from its file's text. Raises `ValueError`, naming the prompt and what is wrong with it."""
    parts = re.split(r"^[ \t]*---[ \t]*$", text, maxsplit=2, flags=re.MULTILINE)
    if len(parts) < 3 or parts[0]:
        raise ValueError(f"Prompt {name!r} does not begin with front matter between two lines of '---'.")
    head: Any = yaml.safe_load(parts[1])
    if not isinstance(head, dict) or set(head) != set(FIELDS):
        raise ValueError(f"Prompt {name!r} needs exactly these fields in its front matter: {', '.join(FIELDS)}.")
    for field, kind in FIELDS.items():
        if not isinstance(head[field], kind) or isinstance(head[field], bool):
            raise ValueError(f"Prompt {name!r}: {field} must be of type {kind.__name__}, not {head[field]!r}.")
    body = parts[2].strip()
    inputs = tuple(str(item) for item in head["inputs"])
    undeclared = find_undeclared_variables(_ENVIRONMENT.parse(body)) - set(inputs)
    if undeclared:
        raise ValueError(f"Prompt {name!r} uses inputs that it does not declare: {', '.join(sorted(undeclared))}.")
    return Prompt(name, head["version"], inputs, body)
