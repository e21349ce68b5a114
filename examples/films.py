"""Makes the short films of the start page, `film.mp4` beside each picture; again where compositor or physics change.

python examples/films.py
"""

import json
import tempfile
from pathlib import Path

from cow_service.media.video import frames_of, write_mp4
from cow_service.requests import SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings
from cow_service.weights.manifests import EXAMPLES

HERE = Path(__file__).parent
SIDE, REST = 320, 0.8  # px; s for which it stays as it ends

with tempfile.TemporaryDirectory() as data:
    service = Service(Settings(data_dir=Path(data), reader="embedded"))
    for folder in (HERE / name for name in EXAMPLES):
        image = service.keep_image((folder / "image.jpg").read_bytes())
        question = json.loads((folder / "meta.json").read_text())["question"]
        request = SimulateRequest.model_validate({"image": {"artifact": image.sha256}, "question": question})
        simulation = service.simulate(request)
        assert simulation.video is not None
        frames, fps = frames_of(service.artifacts.read(simulation.video.sha256), SIDE)
        until = simulation.trajectory.moving_until or len(frames) / fps
        frames = frames[: min(len(frames), round((until + REST) * fps))]
        height, width = frames[0].shape[:2]
        out = folder / "film.mp4"
        write_mp4(frames, out, fps=fps, width=width, height=height)
        outcome = simulation.trajectory.outcome
        print(out.parent.name, out.stat().st_size, "bytes,", outcome and (outcome.probability, outcome.sure))
