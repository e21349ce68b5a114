"""Measures answers: the embedded reader's against scenes with known truth, and the overhead of asking an MLLM.

    python benchmarks/answers.py DIR ... [--runs N] [--json FILE] [--diagram FILE]

Each DIR holds one folder per scene with image.jpg and meta.json, as `examples/` does. Each scene is asked as a caller
would, by image and question alone; right, wrong and not sure are counted, and what is told with a probability is scored
(Brier) and drawn against what is so, as a reliability diagram with a curve for each DIR. Then one scene is answered
through a server on loopback that replies at once: what is left is our own time (prompts, images, HTTP, reading the
replies, simulation).
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import threading
import time
from collections import Counter
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from cow_service.evals.report.figures import draw_curves
from cow_service.evals.statistics import Calibration, calibration_of
from cow_service.requests import AnswerRequest
from cow_service.service import Service
from cow_service.settings import Settings

YES = "A"  # the option that says that it happens, in the scenes' questions


class Instant(BaseHTTPRequestHandler):
    """Replies at once: the object, its place and a letter, whichever is asked for."""

    protocol_version = "HTTP/1.1"
    replies: dict[str, dict[str, Any]] = {}  # noqa: RUF012

    def log_message(self, format: str, *args: object) -> None:
        """Says nothing."""

    def do_POST(self) -> None:
        """One completion, told by a field that only its schema has."""
        body = json.loads(self.rfile.read(int(self.headers["content-length"])))
        fields = body["response_format"]["json_schema"]["schema"]["properties"]
        text = next(json.dumps(reply) for field, reply in self.replies.items() if field in fields)
        choice = {"index": 0, "finish_reason": "stop", "message": {"role": "assistant", "content": text}}
        data = json.dumps(
            {"id": "x", "object": "chat.completion", "created": 0, "model": "instant", "choices": [choice]}
        ).encode()
        self.send_response(200)
        self.send_header("content-type", "application/json")
        self.send_header("content-length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)


def request_of(service: Service, folder: Path, **body: Any) -> AnswerRequest:
    """The image and question of a scene."""
    meta = json.loads((folder / "meta.json").read_text())
    image = service.keep_image((folder / "image.jpg").read_bytes())
    return AnswerRequest.model_validate(
        {"image": {"artifact": image.sha256}, "question": meta["question"], "video": False} | body
    )


def measure_scenes(service: Service, folders: list[Path]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """A row per scene, and the counts."""
    rows: list[dict[str, Any]] = []
    for folder in folders:
        meta = json.loads((folder / "meta.json").read_text())
        started = time.perf_counter()
        answer = service.answer(request_of(service, folder))
        told = None if answer.simulation is None else answer.simulation.trajectory.outcome
        rows.append(
            {
                "scene": folder.name,
                "truth": meta["answer"],
                "answer": answer.answer,
                "probability": None if told is None or told.asked.form != "whether" else told.probability,
                "outcome": "not sure" if answer.not_sure else "right" if answer.answer == meta["answer"] else "wrong",
                "ms": round(1000 * (time.perf_counter() - started), 1),
            }
        )
    counts = Counter(row["outcome"] for row in rows)
    summary: dict[str, Any] = {name: counts[name] for name in ("right", "wrong", "not sure")}
    told = [(row["probability"], row["truth"] == YES) for row in rows if row["probability"] is not None]
    if told:
        summary["calibration"] = calibration_of(told).model_dump(mode="json")
    return rows, summary | {"p50_ms": round(statistics.median(row["ms"] for row in rows), 1)}


def measure_overhead(folder: Path, runs: int) -> dict[str, float]:
    """Milliseconds of an answer whose every call of the MLLM is answered at once, and without a simulation."""
    meta = json.loads((folder / "meta.json").read_text())
    width, height = meta["image_size"]

    def place(name: str) -> dict[str, Any]:
        bbox = meta["bbox"] if name == meta["object"] else meta["boxes"][name][0]
        return {
            "bbox_2d": [round(1000 * v / s) for v, s in zip(bbox, (width, height) * 2, strict=True)],
            "label": name,
        }

    names = [meta["object"], *(name for name in meta["boxes"] if name != meta["object"])]
    x0, y0, x1, y1 = place(meta["object"])["bbox_2d"]
    start = [(x0 + x1) // 2, (y0 + y1) // 2]
    end = [at + round(200 * way) for at, way in zip(start, meta["direction"], strict=True)]
    Instant.replies = {
        "kind": {"reasoning": "", "object": meta["object"], "others": [], "kind": "linear"},
        "objects": {"reasoning": "", "objects": [*map(place, names)], "start": start, "end": end, "sense": None},
        "answer": {"reasoning": "", "answer": "A"},
    }
    with ThreadingHTTPServer(("127.0.0.1", 0), Instant) as server, tempfile.TemporaryDirectory() as data:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/v1"
        settings = Settings(data_dir=Path(data), mllm="qwen3-vl-8b", mllm_base_url=address)
        with Service(settings) as service:
            figures: dict[str, float] = {}
            for imagine in ("always", "never"):
                request = request_of(service, folder, imagine=imagine)
                service.answer(request)
                times: list[float] = []
                for _ in range(runs):
                    started = time.perf_counter()
                    service.answer(request)
                    times.append(1000 * (time.perf_counter() - started))
                figures[f"imagine {imagine}, p50_ms"] = round(statistics.median(times), 1)
        server.shutdown()
    return figures


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--json", type=Path, default=None, help="write rows and summaries here")
    parser.add_argument("--diagram", type=Path, default=None, help="draw the reliability diagram here (PNG or SVG)")
    arguments = parser.parse_args()
    scenes = {each.name: sorted(path.parent for path in each.glob("*/meta.json")) for each in arguments.folders}
    for name, folders in scenes.items():
        if not folders:
            print(f"No scenes in {name}: it needs folders with image.jpg and meta.json.", file=sys.stderr)
            return 2
    rows: dict[str, list[dict[str, Any]]] = {}
    summaries: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as data, Service(Settings(data_dir=Path(data), reader="embedded")) as service:
        for name, folders in scenes.items():
            rows[name], summaries[name] = measure_scenes(service, folders)
    for name, found in rows.items():
        table = Table(box=None, pad_edge=False, title=name)
        for column in found[0]:
            table.add_column(column)
        for row in found:
            table.add_row(*(str(value) for value in row.values()))
        Console(width=120).print(table)
    for name, found in summaries.items():
        brier = f"; Brier score {found['calibration']['brier']:.3f}" if "calibration" in found else ""
        counted = ", ".join(f"{found[outcome]} {outcome}" for outcome in ("right", "wrong", "not sure"))
        print(f"{name}: {counted}{brier}; p50 {found['p50_ms']} ms")
    overhead = measure_overhead(next(iter(scenes.values()))[0], arguments.runs)
    for name, value in overhead.items():
        print(f"{name}: {value}")
    if arguments.diagram is not None:
        curves = [
            ([name], Calibration.model_validate(found["calibration"]))
            for name, found in summaries.items()
            if "calibration" in found
        ]
        draw_curves(curves).savefig(arguments.diagram, dpi=120)
    if arguments.json is not None:
        arguments.json.write_text(
            json.dumps({"summaries": summaries, "overhead": overhead, "scenes": rows}, indent=2) + "\n"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
