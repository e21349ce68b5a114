"""How the service answers when the multimodal LLM that reads for it errs, by what it errs in and by how much.

    python benchmarks/erring_reader.py DIR ... [--levels truth dir20 ...] [--most N] [--json FILE]

Each DIR holds one folder per scene with image.jpg and meta.json. A server on loopback stands in for the MLLM: it knows
the truth of every scene and tells it with the errors of a level. What counts is what the simulation says to the
question: right, wrong or not sure.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from cow_service.errors import CowError
from cow_service.records import Outcome, Simulation
from cow_service.requests import SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings

# What goes wrong: shares of a box's sides, degrees of a direction, and what is left out or turned round.
LEVELS: dict[str, dict[str, Any]] = {
    "truth": {},
    **{f"box{share}": {"box": share / 100} for share in (5, 10, 20)},
    **{f"dir{degrees}": {"angle": degrees} for degrees in (10, 20, 40)},
    **{f"dir{degrees}, no cue": {"angle": degrees, "no_cue": True} for degrees in (20, 40)},
    "box10 and dir10": {"box": 0.1, "angle": 10},
    "mirrored": {"angle": 180},
    "sense passed over": {"angle": 180, "other_sense": True},
    "negated": {"negated": True},
    "no target": {"no_target": True},
    "another mover": {"another_mover": True},
    "one thing missed": {"missed": 1},
    "two things missed": {"missed": 2},
    "the target missed": {"target_missed": True},
    "a removal left out": {"removal_missed": True},
}
MODEL = "qwen3-vl-30b-a3b"
RELATIONS = {"occlusion": "covers", "compatibility": "inside"}  # by task; else `touches`


def asked_of(meta: dict[str, Any]) -> dict[str, Any]:
    """What a scene's question asks, as a reply says it."""
    text, form = meta["question"].lower(), meta.get("form", "")
    falls = meta.get("motion", form) == "fall" and form != "place"
    asked: dict[str, Any] = {"form": "whether", "relation": RELATIONS.get(meta.get("task", ""), "touches")}
    if falls or "land on" in text:
        asked["relation"] = "touches"
    if "billiards" in form or form == "tra2b":
        asked["subject"] = meta.get("via") or meta["chain"]["via"]
    if form in ("occ2", "com2"):
        return asked | {"form": "which", "among": [meta["target"], meta["via"]]}
    if "first" in text:
        return asked | {"form": "which-first", "among": [each for each in meta["options"] if each.startswith("the ")]}
    return asked | {"target": meta["target"]}


def kind_of(meta: dict[str, Any]) -> str:
    """The kind of motion."""
    said = meta.get("motion") or meta.get("form", "")
    if said == "place" or (meta.get("task") == "compatibility" and said.startswith("com")):
        return "place"
    if said in ("fall", "projectile"):
        return "place" if meta.get("form") == "place" else said
    return "fall" if "falls freely" in meta["question"] else "linear"


class StandIn(BaseHTTPRequestHandler):
    """Replies with the truth of `meta` and the errors of `level`, to whichever fields a schema asks for."""

    protocol_version = "HTTP/1.1"
    meta: dict[str, Any] = {}  # noqa: RUF012
    level: dict[str, Any] = {}  # noqa: RUF012

    def log_message(self, format: str, *args: object) -> None:
        """Says nothing."""

    def do_POST(self) -> None:
        """One completion, told by fields that only its schema has."""
        body = json.loads(self.rfile.read(int(self.headers["content-length"])))
        fields = body["response_format"]["json_schema"]["schema"]["properties"]
        if "kind" in fields:
            reply = self.identified()
        elif "metres" in fields:
            reply = {"metres": None, "down": "bottom"}
        else:
            reply = {name: value for name, value in self.located().items() if name in fields}
        message = {"role": "assistant", "content": json.dumps({"reasoning": ""} | reply)}
        choice = {"index": 0, "finish_reason": "stop", "message": message}
        whole = {"id": "x", "object": "chat.completion", "created": 0, "model": "stand-in", "choices": [choice]}
        data = json.dumps(whole).encode()
        self.send_response(200)
        self.send_header("content-type", "application/json")
        self.send_header("content-length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)

    @property
    def mover(self) -> str:
        """What is said to move."""
        own, target = self.meta["object"], self.meta["target"]
        others = [name for name in self.meta["boxes"] if name not in (own, target)]
        return (others or [target])[0] if self.level.get("another_mover") else own

    def identified(self) -> dict[str, Any]:
        """What is asked, and what moves."""
        meta, asked = self.meta, asked_of(self.meta)
        asked["negated"] = bool(self.level.get("negated"))
        if self.level.get("no_target"):
            asked["target"] = None
        removed = meta.get("removed") or []
        gone = [] if self.level.get("removal_missed") else [removed] if isinstance(removed, str) else removed
        changes: list[dict[str, Any]] = [{"kind": "remove", "object": name} for name in gone]
        if kind_of(meta) == "place":
            changes.append({"kind": "place", "object": meta["object"], "relation": "into", "targets": [meta["target"]]})
        named = [name for name in (meta["target"], meta.get("via")) if name]
        return {
            "object": self.mover, "others": named, "asked": asked, "kind": kind_of(meta), "changes": changes,
            "language": "en",
        }  # fmt: skip

    def located(self) -> dict[str, Any]:
        """Where things are, and which way it goes; the same errors each time that it is asked."""
        meta, level, rng = self.meta, self.level, random.Random(self.meta["id"])
        width, height = meta["image_size"]
        boxes = {name: box[0] if isinstance(box[0], list) else box for name, box in meta["boxes"].items()}
        if "bbox" in meta:
            boxes[meta["object"]] = meta["bbox"]

        def told(name: str) -> list[int]:
            x0, y0, x1, y1 = boxes[name]
            off = [rng.uniform(-1, 1) * level.get("box", 0.0) for _ in range(4)]
            sides = (x1 - x0, y1 - y0) * 2
            moved = (edge + share * side for edge, share, side in zip(boxes[name], off, sides, strict=True))
            spans = (width, height) * 2
            return [round(1000 * min(max(edge / span, 0.0), 1.0)) for edge, span in zip(moved, spans, strict=True)]

        others = [name for name in boxes if name != self.mover]
        target, dropped = meta["target"], [name for name in others if name != meta["target"]]
        rng.shuffle(dropped)
        missing = {target} if level.get("target_missed") else set(dropped[: level.get("missed", 0)])
        turn = math.radians(level.get("angle", 0) * rng.choice((-1, 1)))
        dx, dy = meta["direction"] or (0.0, 1.0)
        dx, dy = dx * math.cos(turn) - dy * math.sin(turn), dx * math.sin(turn) + dy * math.cos(turn)
        x0, y0, x1, y1 = boxes[self.mover]
        x, y, reach = (x0 + x1) / 2, (y0 + y1) / 2, 200.0
        while reach > 10 and not (0 <= x + reach * dx <= width and 0 <= y + reach * dy <= height):
            reach *= 0.9
        points = (x, y), (x + reach * dx, y + reach * dy)
        start, end = ([round(1000 * a / width), round(1000 * b / height)] for a, b in points)
        has_arrow = "arrow" in meta["question"] and not level.get("no_cue")
        along = ("opposite" not in meta["question"]) != bool(level.get("other_sense"))
        seen = [self.mover, *(name for name in others if name not in missing)]
        return {
            "objects": [{"bbox_2d": told(name), "label": name} for name in seen], "start": start, "end": end,
            "sense": ("with" if along else "against") if has_arrow else None,
        }  # fmt: skip


def verdict(meta: dict[str, Any], simulation: Simulation) -> str:
    """What the simulation says to the question: right, wrong or not sure."""
    outcome: Outcome | None = simulation.trajectory.outcome
    truth = meta.get("answer_text") or ("Yes" if meta["answer"] == "A" else "No")
    if outcome is None or not outcome.sure:
        return "not sure"
    if outcome.asked.form == "which-first":
        said = outcome.first or "floor"
        return "right" if said.removeprefix("the ") == truth.removeprefix("the ") else "wrong"
    if outcome.asked.form == "which":
        among = [each.object for each in outcome.candidates if each.is_meant]
        said = {0: "neither", 2: "both"}.get(len(among), f"only the {among[0].removeprefix('the ') if among else ''}")
        return "right" if said == truth else "wrong"
    return "right" if outcome.happens == (truth == "Yes") else "wrong"


def measure(service: Service, folder: Path) -> dict[str, Any]:
    """The row of a scene."""
    meta = StandIn.meta
    image = service.keep_image((folder / "image.jpg").read_bytes())
    body = {"image": {"artifact": image.sha256}, "question": meta["question"], "video": False}
    try:
        simulation = service.simulate(SimulateRequest.model_validate(body))
    except CowError as error:
        return {"scene": folder.name, "told": "refused", "why": error.code}
    outcome = simulation.trajectory.outcome
    row = {"scene": folder.name, "told": verdict(meta, simulation)}
    return row | ({} if outcome is None else {"p": outcome.probability, "depends_on": outcome.depends_on})


def rows_of(folders: list[Path], address: str) -> Iterator[dict[str, Any]]:
    """The rows of scenes, for an MLLM at an address."""
    with tempfile.TemporaryDirectory() as data:
        settings = Settings(data_dir=Path(data), mllm=MODEL, mllm_base_url=address)
        with Service(settings) as service:
            for folder in folders:
                StandIn.meta = json.loads((folder / "meta.json").read_text())
                yield measure(service, folder)


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--levels", nargs="+", default=list(LEVELS), choices=LEVELS)
    parser.add_argument("--most", type=int, default=30, help="scenes of each DIR")
    parser.add_argument("--json", type=Path, default=None, help="write rows and summaries here")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    summaries: list[dict[str, Any]] = []
    with ThreadingHTTPServer(("127.0.0.1", 0), StandIn) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/v1"
        for family in arguments.folders:
            scenes = sorted(path.parent for path in family.glob("*/meta.json"))
            picked = sorted(random.Random(0).sample(scenes, min(arguments.most, len(scenes))))
            for name in arguments.levels:
                StandIn.level, found = LEVELS[name], Counter[str]()
                for row in rows_of(picked, address):
                    found[row["told"]] += 1
                    rows.append({"family": family.name, "level": name} | row)
                told = ", ".join(f"{found[each]} {each}" for each in ("right", "wrong", "not sure", "refused"))
                print(f"{family.name}, {name}: {told}", flush=True)
                summaries.append({"family": family.name, "level": name} | dict(found))
        server.shutdown()
    if arguments.json is not None:
        arguments.json.write_text(json.dumps({"summaries": summaries, "scenes": rows}, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
