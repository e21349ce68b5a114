"""The fields of requests under flat names, for callers that do not nest: command line, MCP.

The table has the names; types, defaults and descriptions are those of the request models.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from cow_service.records import JobKind
from cow_service.requests.simulation import AnswerRequest, SimulateRequest

REQUESTS: dict[JobKind, type[SimulateRequest]] = {"simulate": SimulateRequest, "answer": AnswerRequest}


@dataclass(frozen=True)
class FlatField:
    """A field of a request, and its names; None where it has none."""

    path: str  # in the request, such as motion/speed
    option: str | None  # of `cow simulate` and `cow answer`, as Python has it
    argument: str | None  # of the MCP tools
    kinds: tuple[JobKind, ...] = ("simulate", "answer")


FLAT = {  # by the group in the help of a command
    "The question": (FlatField("question", None, "question"),),
    "The moving object": (
        FlatField("grounding/object", "object", "object"),
        FlatField("grounding/bbox", "box", "bbox"),
        FlatField("grounding/point", "point", "point"),
    ),
    "Its motion": (
        FlatField("motion/direction", "direction", "direction"),
        *(FlatField(f"motion/{name}", name, name) for name in ("towards", "along_arrow", "forward", "cue")),
        FlatField("motion/kind", "kind", "motion_kind"),
        *(FlatField(f"motion/{name}", name, name) for name in ("speed", "distance", "duration", "until", "law")),
        FlatField("trajectory", "trajectory", None),
    ),
    "The scene": (
        FlatField("interventions", "remove", "remove"),
        FlatField("interventions", "place", "place"),
        FlatField("objects", "other", "objects"),
        FlatField("objects_complete", None, "objects_complete"),
        FlatField("depth/map", "depth", None),
        FlatField("depth/scale", "depth_scale", None),
    ),
    "The simulation": (
        FlatField("asked", None, "asked"),
        FlatField("ensemble", "ensemble", None),
        FlatField("reader", "reader", "reader"),
        FlatField("language", "language", None),
        FlatField("seed", "seed", "seed"),
    ),
    "The frames": (
        FlatField("generator", "generator", "generator"),
        FlatField("generator_options", "option", None),
        FlatField("num_frames", "num_frames", "num_frames"),
        FlatField("fps", "fps", None),
        FlatField("frames/policy", "frames", "frames_policy"),
        FlatField("frames/count", "count", "frames_count"),
        FlatField("frames/max_side", "max_side", None),
        FlatField("video", "video", "video", ("simulate",)),
    ),
    "The answer": (
        FlatField("options", "choice", "options", ("answer",)),
        *(
            FlatField(name, name, name, ("answer",))
            for name in ("imagine", "imagine_votes", "imagine_threshold", "votes", "baseline")
        ),
    ),
}


def flat_fields(kind: JobKind) -> dict[FlatField, dict[str, Any]]:
    """The flat fields of a kind of request, each with its JSON schema as `inlined` has it."""
    whole, found = inlined(REQUESTS[kind].model_json_schema()), dict[FlatField, dict[str, Any]]()
    for field in (each for group in FLAT.values() for each in group if kind in each.kinds):
        found[field] = whole
        for name in field.path.split("/"):
            found[field] = found[field]["properties"][name]
    return found


def put(request: dict[str, Any], path: str, value: Any) -> None:
    """Sets a field of a request; what stands in its interventions stays."""
    *records, name = path.split("/")
    for record in records:
        request = request.setdefault(record, {})
    request[name] = [*request.get(name, ()), *value] if name == "interventions" else value


def inlined(schema: dict[str, Any], exclude: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """A JSON schema with each reference replaced, and without parts that tell a model nothing.

    Those are titles and defaults of null; in arguments also null itself, which is always allowed. `exclude` names the
    fields of results to leave out, as `BaseModel.model_dump` takes it.
    """
    records = schema.get("$defs", {})

    def walk(schema: dict[str, Any], left_out: Mapping[str, Any]) -> dict[str, Any]:
        if (reference := schema.get("$ref")) is not None:
            schema = records[reference.rpartition("/")[2]] | {key: one for key, one in schema.items() if key != "$ref"}
        choices = [one for one in schema.get("anyOf", ()) if one != {"type": "null"}]
        if len(choices) == 1 and exclude is None:
            return walk(choices[0] | {key: one for key, one in schema.items() if key != "anyOf"}, left_out)
        needless = {"$defs", "title"} | ({"default"} if schema.get("default", ...) is None else set[str]())
        found = {key: one for key, one in schema.items() if key not in needless}
        forms = {"anyOf", "oneOf", "prefixItems"} & found.keys()
        found |= {key: [walk(one, left_out) for one in found[key]] for key in forms}
        if isinstance(found.get("items"), dict):
            found["items"] = walk(found["items"], left_out.get("__all__", {}))
        if "properties" in found:
            kept = {name: one for name, one in found["properties"].items() if left_out.get(name) is not True}
            found["properties"] = {name: walk(one, left_out.get(name, {})) for name, one in kept.items()}
            found["required"] = [name for name in found.get("required", ()) if name in kept]
        return found

    return walk(schema, exclude or {})
