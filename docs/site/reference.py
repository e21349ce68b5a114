"""Reference pages of the site, made from the code when mkdocs builds them.

A page takes its part where it says `<!-- reference -->`, else at its end; a page that does not exist has nothing else.
Links that leave docs/ lead to the repository (COW_REPOSITORY), or become plain text.
"""

import inspect
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import yaml
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from pydantic import SecretStr
from pydantic.fields import FieldInfo
from typer.main import get_command

from cow_service import client, errors
from cow_service.cli.main import app
from cow_service.client.protocol import RETRYABLE
from cow_service.settings import Settings

ROOT = Path(__file__).resolve().parents[2]
API = yaml.safe_load((ROOT / "openapi.yaml").read_text())
SCHEMAS: dict[str, Any] = API["components"]["schemas"]
LIMITS = {"minimum": "≥ {}", "exclusiveMinimum": "> {}", "maximum": "≤ {}", "maxLength": "at most {} characters"}
LIMITS |= {"minItems": "at least {}", "maxItems": "at most {}"}
UNITS = {"second": "s", "longest wait": "s", "hours": "h", " MB": "MB", " GB": "GB", "millions of pixels": "megapixels"}
OF_THE_MACHINE = {"data_dir": "by the user", "concurrency": "by the machine"}  # their defaults
Rows = Iterable[Iterable[object]]


def table(head: str, rows: Rows) -> str:
    """A Markdown table; `head` has the names of its columns with commas between."""
    columns = head.split(", ")
    lines = [columns, ["---"] * len(columns), *rows]
    cells = ([re.sub(r"\s+", " ", str(cell)) for cell in line] for line in lines)
    cells = ([re.sub(r"(`[^`]*`)|\|", lambda found: found[1] or r"\|", cell) for cell in line] for line in cells)
    return "".join(f"| {' | '.join(line)} |\n" for line in cells) + "\n"


def kind_of(schema: dict[str, Any]) -> str:
    """The type of a JSON schema in words, with its limits; records are links."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}](records.md#{name.lower()})"
    if either := schema.get("anyOf") or schema.get("oneOf"):
        return " or ".join(dict.fromkeys(map(kind_of, either)))
    if "enum" in schema or "const" in schema:
        return ", ".join(f"`{value}`" for value in schema.get("enum", [schema.get("const")]))
    kind = schema.get("type", "any")
    limits = [words.format(schema[name]) for name, words in LIMITS.items() if name in schema]
    if "prefixItems" in schema:
        kind, limits = f"[{', '.join(map(kind_of, schema['prefixItems']))}]", []
    elif kind == "array":
        kind = f"list of {kind_of(schema.get('items', {}))}"
    elif kind == "object" and isinstance(values := schema.get("additionalProperties"), dict):
        kind = f"object of {kind_of(values)}"
    return f"{kind} ({', '.join(limits)})" if limits else kind


def fields_of(schema: dict[str, Any]) -> str:
    """A table of the fields of a record."""
    required = schema.get("required", ())
    rows = (
        (
            f"`{name}`",
            kind_of(field),
            "required" if name in required else f"`{field['default']}`" if field.get("default") is not None else "",
            field.get("description", ""),
        )
        for name, field in schema.get("properties", {}).items()
    )
    return table("field, type, default, meaning", rows)


def endpoints() -> str:
    """Every endpoint of openapi.yaml, by its tag."""
    found: dict[str, str] = {}
    for path, methods in API["paths"].items():
        for method, call in methods.items():
            found[call["tags"][0]] = found.get(call["tags"][0], "") + endpoint(f"{method.upper()} {path}", call)
    return "".join(f"## Endpoints: {tag}\n\n{text}" for tag, text in found.items())


def endpoint(name: str, call: dict[str, Any]) -> str:
    """One endpoint: parameters, body, responses, errors."""
    text = f"### `{name}`\n\n**{call['summary']}.** {call.get('description', '')}\n\n"
    if given := call.get("parameters"):
        rows = (
            (f"`{each['name']}`", each["in"], kind_of(each["schema"]), each.get("description", "")) for each in given
        )
        text += table("parameter, in, type, meaning", rows)
    for media, content in call.get("requestBody", {}).get("content", {}).items():
        schema = content["schema"]
        is_record = "$ref" in schema
        text += f"Body, `{media}`: {kind_of(schema)}\n\n" if is_record else f"Body, `{media}`:\n\n{fields_of(schema)}"
    returned, failed = [], []
    for status, response in call["responses"].items():
        contents = response.get("content", {})
        if "application/problem+json" in contents:
            failed.append(f"{status} " + re.sub(r"`([\w-]+)`", r"[`\1`](errors.md#\1)", response["description"]))
        else:
            kinds = (f"`{media}` {kind_of(each.get('schema', {}))}" for media, each in contents.items())
            words = response["description"].replace("Successful Response", "")
            returned.append((status, "<br>".join(kinds), words))
    return text + table("status, response, when", returned) + f"Errors: {'; '.join(failed)}.\n\n"


def records() -> str:
    """Every record of openapi.yaml, those of requests first."""
    found = {"Requests": "", "Results": ""}
    for name, schema in SCHEMAS.items():
        group = "Requests" if name.endswith("Request") else "Results"
        found[group] += f"### {name}\n\n{schema.get('description', '')}\n\n{fields_of(schema)}"
    return "".join(f"## {group}\n\n{text}" for group, text in found.items())


def sdk() -> str:
    """What mkdocstrings is to show of the SDK."""
    classes = {name: each for name in client.__all__ if inspect.isclass(each := getattr(client, name))}
    modules = {name: f"{each.__module__}.{name}" for name, each in classes.items()}
    shown = ("Client", "Answer", "Simulation", "JobHandle", "BatchResult", "Question", "Event", "Models")
    text = "## Classes\n\nResults have the fields of their [records](records.md), too.\n\n"
    text += "".join(f"::: {modules[name]}\n\n" for name in shown)
    summary = "    options: {members: false, summary: {functions: true, attributes: true}}\n\n"
    return text + "".join(f"::: {modules[name]}\n{summary}" for name in modules if name.startswith("Async"))


def commands() -> str:
    """Every command of `cow`, with what its help says."""
    return "".join(command(get_command(app), None, "cow"))


def command(it: Any, parent: Any, path: str) -> Iterator[str]:
    """A command and those below it."""
    context = it.make_context(path.rpartition(" ")[2], [], parent=parent, resilient_parsing=True)
    below = [each for each in getattr(it, "commands", {}).items() if not each[1].hidden]
    if parent is not None and (it.callback or not below):
        usage = " ".join([path, *it.collect_usage_pieces(context)])
        yield f"## `{path}`\n\n{inspect.cleandoc(it.help or '')}\n\n```text\n{usage}\n```\n\n"
        told = [each.get_help_record(context) for each in it.get_params(context) if each.name != "help"]
        rows = ((f"`{names}`", words.replace("<", "&lt;")) for names, words in filter(None, told))
        yield table("option, meaning", rows)
    for name, each in below:
        yield from command(each, context, f"{path} {name}")


def settings() -> str:
    """Every setting, with type, default and sentence."""
    schema = Settings.model_json_schema()["properties"]
    rows = (
        (
            f'<span id="cow_{name}"></span>`COW_{name.upper()}`',
            default_of(name, field),
            kind_of(schema[name]).removesuffix(" or null"),
            field.description,
        )
        for name, field in Settings.model_fields.items()
    )
    return table("setting, default, values, meaning", rows)


def default_of(name: str, field: FieldInfo) -> str:
    """The default of a setting, with its unit."""
    if name in OF_THE_MACHINE:
        return OF_THE_MACHINE[name]
    value = field.get_default(call_default_factory=True, validated_data={})
    if value is None or isinstance(value, SecretStr) or value in ((), {}):
        return "none"
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    words = (field.description or "").lower()
    unit = next((unit for sign, unit in UNITS.items() if sign.lower() in words), "") if is_number else ""
    return f"`{str(value).lower() if isinstance(value, bool) else value}` {unit}".rstrip()


def codes(text: str) -> str:
    """Every error, with the words that the page's own table, `| code | when |`, has for it."""
    told: dict[str, str] = {}
    for names, words in re.findall(r"^\| ?((?:`[\w-]+`,? ?)+)\|(?:[ \d]+\|)? (.*) \|$", text, re.MULTILINE):
        told |= dict.fromkeys(re.findall(r"`([\w-]+)`", names), words)
    rows = (
        (
            f'<span id="{code}"></span>`{code}`',
            kind.status,
            (kind.__doc__ or "").strip(),
            "yes" if issubclass(kind, RETRYABLE) else "no",
            told.get(code, ""),
        )
        for code, kind in sorted(errors.kinds().items())
    )
    return table("code, status, meaning, sent again by the SDK, when and what to do", rows)


REFERENCE: dict[str, tuple[str, Callable[[], str]]] = {
    "http.md": ("The HTTP API", endpoints),
    "records.md": ("Requests and results", records),
    "sdk.md": ("The Python SDK", sdk),
    "cli.md": ("The command line", commands),
    "settings.md": ("Settings", settings),
}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the reference pages that no file begins."""
    for name, (title, _) in [*REFERENCE.items(), ("errors.md", ("Errors", None))]:
        if files.get_file_from_path(name) is None:
            files.append(File.generated(config, name, content=f"# {title}\n"))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Puts the reference into its pages, and turns links that leave docs/."""
    base = f"{config.repo_url.rstrip('/')}/blob/main/" if config.repo_url else None

    def turned(found: re.Match[str]) -> str:
        return f"[{found[1]}]({base}{found[2]})" if base else found[1]

    markdown = re.sub(r"(?<!!)\[([^\[\]]+)\]\(\.\./([^)\s]+)\)", turned, markdown)
    name = page.file.src_uri
    if name in (*REFERENCE, "errors.md"):  # searches find the pages that explain first
        page.meta["search"] = {"boost": 0.5}
    if name == "errors.md":
        own = re.compile(r"^\| code \|.*\n\|[-| ]+\n(?:\|.*\n)+", re.MULTILINE)
        markdown = own.sub(lambda found: codes(found[0]), markdown) if own.search(markdown) else markdown + codes("")
    elif name in REFERENCE:
        text, mark = REFERENCE[name][1](), "<!-- reference -->"
        markdown = markdown.replace(mark, text) if mark in markdown else f"{markdown}\n\n{text}"
    return markdown
