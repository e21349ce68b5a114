"""Where the milliseconds of a simulation go: by stage and by function, at two image sizes.

    python benchmarks/profile_stages.py [--runs N] [--top N] [--image FILE --question TEXT --request JSON] [--json FILE]

The pipeline runs in this process, without server and job engine, every time anew. Stage times are medians in
milliseconds of runs that nothing else watches. Functions are then found by sampling: every millisecond the stack is
looked at, and the time since the last look counts for it; a call into a library counts for the line that makes it.
`own` is the share of a function itself, `whole` with all that it calls. By default the example image (832x480) with and
without its clip, and a photograph of 12 megapixels, made from the examples, with its point and direction given.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import statistics
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import cv2
import numpy as np

from cow_service.pipeline import simulate
from cow_service.requests import SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "ball-and-mug"
INTERVAL = 0.001  # seconds between looks at the stack
PHOTO = 4000, 3000  # px
GIVEN: dict[str, Any] = {"grounding": {"point": [1650, 1870]}, "motion": {"direction": [1, 0]}, "video": False}


def photograph(width: int, height: int) -> bytes:
    """A JPEG of that size: an example enlarged, with the noise of a sensor."""
    image = cv2.imread(str(EXAMPLE / "image.jpg"))
    assert image is not None
    large = cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC).astype(np.float32)
    noise = np.random.default_rng(0).normal(0, 3, (height, width, 1)).astype(np.float32)
    _, encoded = cv2.imencode(".jpg", np.clip(large + noise, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 90])
    return encoded.tobytes()


class Samples:
    """How long each function was seen at work, seconds."""

    def __init__(self) -> None:
        self.own: dict[str, float] = defaultdict(float)
        self.whole: dict[str, float] = defaultdict(float)
        self._last = 0.0

    @contextmanager
    def taken(self) -> Generator[None]:
        """Looks at the stack of this thread, which must be the main one, while the block runs."""
        signal.signal(signal.SIGALRM, self._look)
        self._last = time.perf_counter()
        signal.setitimer(signal.ITIMER_REAL, INTERVAL, INTERVAL)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)

    def _look(self, _: int, frame: FrameType | None) -> None:
        now = time.perf_counter()
        passed, self._last = now - self._last, now
        first, seen = True, set[str]()
        while frame is not None:
            code = frame.f_code
            path = Path(code.co_filename)
            name = f"{path.parent.name}/{path.name}:{code.co_qualname}"
            if first:
                self.own[f"{name}:{frame.f_lineno}"] += passed
            if name not in seen:
                self.whole[name] += passed
            seen.add(name)
            first, frame = False, frame.f_back

    def told(self, runs: int, top: int) -> dict[str, Any]:
        """The dearest, milliseconds of one run."""
        return {
            kind: {
                name: round(1000 * seconds / runs, 1)
                for name, seconds in sorted(found.items(), key=lambda each: -each[1])[:top]
            }
            for kind, found in (("own", self.own), ("whole", self.whole))
        }


def profiled(image: bytes, question: str, request: dict[str, Any], runs: int, top: int) -> dict[str, Any]:
    """Milliseconds of one request: whole, by stage, by function; and the bytes that it keeps."""
    with tempfile.TemporaryDirectory() as folder:
        service = Service(Settings(data_dir=Path(folder)))

        def once() -> dict[str, float]:
            started = time.perf_counter()
            artifact = service.keep_image(image)
            asked = {"image": {"artifact": artifact.sha256}, "question": question, **request}
            run = service.prepare(SimulateRequest.model_validate(asked))
            kept = time.perf_counter()
            found = simulate(run)
            ended = time.perf_counter()
            return {"whole": ended - started, "image": kept - started, **found.timings}

        times = [once() for _ in range(runs + 2)][2:]
        samples = Samples()
        with samples.taken():
            _repeat(once, runs)
        size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
        stages = {name: _median([each[name] for each in times]) for name in times[0]}
        return {"p50_ms": stages, "kept_bytes": size, **samples.told(runs, top)}


def _repeat(work: Callable[[], object], runs: int) -> None:
    for _ in range(runs):
        work()


def _median(seconds: list[float]) -> float:
    return round(1000 * statistics.median(seconds), 1)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=15)
    parser.add_argument("--image", type=Path)
    parser.add_argument("--question", default=json.loads((EXAMPLE / "meta.json").read_text())["question"])
    parser.add_argument("--request", type=json.loads, default={"video": False}, help="other fields, JSON")
    parser.add_argument("--top", type=int, default=25, help="functions told of")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    if given.image:
        cases = {given.image.name: (given.image.read_bytes(), given.request, given.runs)}
    else:
        example = (EXAMPLE / "image.jpg").read_bytes()
        cases = {
            "832x480": (example, {"video": False}, given.runs),
            "832x480, 81-frame mp4": (example, {"video": True}, given.runs),
            f"{PHOTO[0]}x{PHOTO[1]}": (photograph(*PHOTO), GIVEN, max(2, given.runs // 5)),
        }
    told: dict[str, Any] = {"cores": os.cpu_count()}
    for name, (image, request, runs) in cases.items():
        told[name] = profiled(image, given.question, request, runs, given.top)
    print(json.dumps(told, indent=1))
    if given.json:
        given.json.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main()
