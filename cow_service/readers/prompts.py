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

from cow_service.weights.manifests import PROMPTS, Resources

# No autoescape: prompts are plain text for a model, and HTML entities would change the words it reads.
_ENVIRONMENT = ImmutableSandboxedEnvironment(autoescape=False, undefined=StrictUndefined, trim_blocks=True)


@dataclass(frozen=True)
class Prompt:
    """A prompt and its inputs, which are the names that its body uses. It does not call a model."""

    name: str
    version: int
    inputs: frozenset[str]
    body: str

    def render(self, /, **inputs: object) -> str:
        """The prompt with its inputs put in. Raises `TypeError`, naming inputs that are missing or not used."""
        faults = {"missing": self.inputs - inputs.keys(), "not used": inputs.keys() - self.inputs}
        if problems := [f"{what}: {', '.join(sorted(names))}" for what, names in faults.items() if names]:
            raise TypeError(f"Prompt {self.name!r}, inputs {'; '.join(problems)}.")
        return self.template.render(**inputs).strip()

    @cached_property
    def template(self) -> Template:
        """Its body, compiled, which takes milliseconds."""
        return _ENVIRONMENT.from_string(self.body)


@cache
def load_prompt(name: str, of: Resources = PROMPTS) -> Prompt:
    """A shipped prompt. Raises `LookupError` if there is none, `ValueError` where its file is not well formed."""
    return parse_prompt(name, of.read(name))


def parse_prompt(name: str, text: str) -> Prompt:
    """A prompt from its file's text. Raises `ValueError`, naming the prompt and what is wrong with it."""
    before, *parts = re.split(r"^[ \t]*---[ \t]*$", text, maxsplit=2, flags=re.MULTILINE)
    head: Any = yaml.safe_load(parts[0]) if len(parts) == 2 and not before else None
    if not isinstance(head, dict) or set(head) != {"version"} or type(head["version"]) is not int:
        raise ValueError(f"Prompt {name!r} does not begin with `version: <number>` between two lines of '---'.")
    body = parts[1].strip()
    inputs = frozenset(find_undeclared_variables(_ENVIRONMENT.parse(body)))
    return Prompt(name, head["version"], inputs, body)
