"""Whether the video model works on this machine at all, before `wan_speed.py` says how fast it is.

    python benchmarks/first_contact.py [--toy] [--num-frames N] [--profile exact ...] [--at-once N] [--json FILE]

A transformer of the 14B model's width with two layers and random weights, in the files and under the names of the
published checkpoints, goes the whole way of a user: `cow simulate` in each profile, whose frames are compared with
those of `portable`, and `cow serve` with a clip, a job that is canceled, a GPU that another process fills, and clips
after that. Frames of random weights are noise; what is told is whether two ways compute the same ones. The file has
each row as soon as it is known. `--toy` does the same with the toy's sizes, on whatever device there is.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from threading import Lock as Mutex
from typing import Any

import cv2
import httpx
import numpy as np
import torch
from diffusers import AutoencoderKLWan, WanTransformer3DModel
from safetensors.torch import save_file
from transformers import CLIPImageProcessor, CLIPVisionConfig, CLIPVisionModel, UMT5Config, UMT5EncoderModel

# On a bare GPU machine the package is not installed.
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from wan_models import IMAGE_ENCODER, TEXT_ENCODER, fill

from cow_service.errors import GeneratorUnavailable
from cow_service.generators.wan.checkpoints import diffusers_config, diffusers_names
from cow_service.generators.wan.pipeline import WanTrackPipeline, compose
from cow_service.generators.wan.tiny import make_tiny
from cow_service.weights.device import choose_device
from cow_service.weights.manifests import load_manifests
from cow_service.weights.repositories import Lock, LockedFile, folder_of, write_lock
from tests.golden import original_weights

ROOT = Path(__file__).resolve().parents[1]
ATI, TOY = load_manifests()["ati"], load_manifests()["tiny-ati"].architecture
LAYERS = TOY["num_layers"]  # of the thin one as well: the names of its weights are the toy's
RANK = 4  # of the LoRA
EXAMPLE = ROOT / "examples" / "ball-and-mug"
QUESTION = json.loads((EXAMPLE / "meta.json").read_text())["question"]
READY_SECONDS, CLIP_SECONDS = 240.0, 240.0  # limits
ROOM = 1.5e9  # bytes that are left to a server when another process takes the rest of the GPU's memory

Row = dict[str, Any]


def make_pipeline(toy: bool, device: torch.device) -> WanTrackPipeline:
    """With random weights; all on the CPU."""
    tiny = make_tiny(TOY)
    if toy:
        return tiny
    transformer = WanTransformer3DModel(**diffusers_config(ATI.architecture | {"num_layers": LAYERS}))
    text, picture = {**TEXT_ENCODER}, {**IMAGE_ENCODER}
    text |= {"vocab_size": len(tiny.tokenizer), "num_layers": 1}
    picture |= {"num_hidden_layers": 2}
    text_encoder = UMT5EncoderModel(UMT5Config(**text))
    image_encoder = CLIPVisionModel(CLIPVisionConfig(**picture))
    cpu = torch.device("cpu")
    fill(transformer, torch.bfloat16, device, cpu, transformer._keep_in_fp32_modules)  # pyright: ignore[reportPrivateUsage]
    fill(text_encoder, torch.bfloat16, device, cpu)
    fill(image_encoder, torch.float32, device, cpu)
    return compose(
        transformer=transformer, vae=AutoencoderKLWan(), text_encoder=text_encoder, image_encoder=image_encoder,
        tokenizer=tiny.tokenizer, image_processor=CLIPImageProcessor(),
    )  # fmt: skip


def write_weights(home: Path, toy: bool, device: torch.device) -> None:
    """What `cow models pull ati` would leave in `home/models`, and `home/float8`."""
    pipeline = make_pipeline(toy, device)
    state = pipeline.transformer.state_dict()
    held = {theirs: state[ours].contiguous() for ours, theirs in diffusers_names(original_weights()).items()}
    folders = {part: folder_of(home / "models", source.repository) for part, source in ATI.sources.items()}
    for folder in folders.values():
        folder.mkdir(parents=True)
    for shard in range(2):
        part = {name: held[name] for name in sorted(held)[shard::2]}
        save_file(part, folders["transformer"] / f"diffusion_pytorch_model-0000{shard + 1}-of-00002.safetensors")
    architecture = TOY if toy else ATI.architecture | {"num_layers": LAYERS}
    (folders["transformer"] / "config.json").write_text(json.dumps({**architecture, "_class_name": "WanModel"}))
    for name in ("vae", "text_encoder", "image_encoder", "tokenizer", "image_processor"):
        getattr(pipeline, name).save_pretrained(folders["base"] / name)
    linear = [name for name, weight in held.items() if name.startswith("blocks.") and weight.ndim == 2]
    lora = {
        f"diffusion_model.{name.removesuffix('.weight')}.lora_{end}.weight": torch.randn(shape) * 0.01
        for name in linear
        for end, shape in (("down", (RANK, held[name].shape[1])), ("up", (held[name].shape[0], RANK)))
    }
    save_file(lora, folders["distilled-lora"] / ATI.sources["distilled-lora"].files[0])
    stored = {name: weight.to(torch.float8_e4m3fn) if name in linear else weight for name, weight in held.items()}
    (home / "float8").mkdir()
    save_file(stored, home / "float8" / "model.safetensors")
    (home / "float8" / "config.json").write_text((folders["transformer"] / "config.json").read_text())
    for part, source in ATI.sources.items():
        files = tuple(_locked(file, folders[part]) for file in sorted(folders[part].rglob("*")) if file.is_file())
        lock = Lock(repository=source.repository, revision="0" * 40, patterns=source.files, files=files)
        write_lock(home / "models", lock)


def _locked(file: Path, folder: Path) -> LockedFile:
    with file.open("rb") as data:
        digest = hashlib.file_digest(data, "sha256").hexdigest()
    path = file.relative_to(folder).as_posix()
    return LockedFile(path=path, size=file.stat().st_size, algorithm="sha256", digest=digest)


def environment(home: Path, profile: str, **others: str) -> dict[str, str]:
    """Of a `cow` process that finds these weights. Compiled code is shared: every profile's is of the same block."""
    own = {
        "COW_DATA_DIR": str(home / f"data-{profile}"), "COW_MODELS_DIR": str(home / "models"), "COW_PROFILE": profile,
        "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]),
        "COW_PORT": "0", "NO_COLOR": "1", "TERM": "dumb", "COLUMNS": "200",
    }  # fmt: skip
    if profile in ("small-float8", "fast-stored"):
        own["COW_CHECKPOINTS"] = json.dumps({"ati": str(home / "float8")})
    kept = {name: value for name, value in os.environ.items() if not name.startswith("COW_")}
    return kept | own | others


def simulate(home: Path, profile: str, num_frames: int) -> Row:
    """`cow simulate` in one profile."""
    out = home / f"out-{profile}"
    command = [
        sys.executable, "-m", "cow_service.cli.main", "simulate", str(EXAMPLE / "image.jpg"), QUESTION, "--out",
        str(out), "--generator", "ati", "--num-frames", str(num_frames), "--no-video", "--option", "steps=3",
    ]  # fmt: skip
    begun = time.monotonic()
    try:
        done = subprocess.run(
            command, env=environment(home, profile), capture_output=True, text=True, check=False, timeout=CLIP_SECONDS
        )
    except subprocess.TimeoutExpired:
        return {"name": profile, "exit": None, "said": f"not done after {CLIP_SECONDS} s"}
    row: Row = {"name": profile, "seconds": round(time.monotonic() - begun, 1), "exit": done.returncode}
    if done.returncode:
        return row | {"said": done.stderr[-1500:]}
    found = json.loads((out / "simulation.json").read_text())
    return row | {"timings": found.get("timings"), "warnings": found["warnings"]}


def frames_of(home: Path, profile: str) -> np.ndarray | None:
    """Those that were kept, as grey levels [count, height, width, 3]; None if there are none."""
    files = sorted((home / f"out-{profile}").glob("frame*.*"))
    read = [image for file in files if (image := cv2.imread(str(file))) is not None]
    return np.stack(read).astype(np.float32) if read else None


def compared(home: Path, row: Row) -> Row:
    """With the mean difference from the frames of `portable` in grey levels, and their spread."""
    reference, found = frames_of(home, "portable"), frames_of(home, row["name"])
    if reference is None or found is None or reference.shape != found.shape:
        return row
    apart = round(float(np.abs(found - reference).mean()), 2)
    return row | {"grey_levels_off_portable": apart, "spread": round(float(found.std()), 1)}


@contextmanager
def serving(home: Path, profile: str) -> Generator[str]:
    """A server; yields its address."""
    log = home / "serve.log"
    with log.open("wb") as out:
        own = environment(home, profile, COW_PORT="8123", COW_GENERATOR="ati")
        process = subprocess.Popen(
            [sys.executable, "-m", "cow_service.cli.main", "serve"], env=own, stdout=out, stderr=out
        )
    try:
        deadline, address = time.monotonic() + READY_SECONDS, "http://127.0.0.1:8123"
        while time.monotonic() < deadline:
            if process.poll() is not None:
                raise RuntimeError(f"The server ended: {log.read_text()[-1500:]}")
            try:
                if httpx.get(f"{address}/readyz").status_code == 200:
                    break
            except httpx.TransportError:
                pass
            time.sleep(0.5)
        else:
            raise RuntimeError(f"The server is not ready: {log.read_text()[-1500:]}")
        yield address
    finally:
        process.terminate()
        try:
            process.wait(30)
        except subprocess.TimeoutExpired:
            process.kill()


def over_http(home: Path, profile: str, num_frames: int, device: torch.device, keep: Callable[[Row], None]) -> None:
    """A server in a profile, and what callers do with it."""
    begun = time.monotonic()
    image = "data:image/jpeg;base64," + base64.b64encode((EXAMPLE / "image.jpg").read_bytes()).decode()

    def body(steps: int, seed: int) -> Row:
        own = {"image": image, "question": QUESTION, "generator": "ati", "num_frames": num_frames, "seed": seed}
        return own | {"generator_options": {"steps": steps}}

    with serving(home, profile) as address, httpx.Client(base_url=address, timeout=CLIP_SECONDS) as http:
        keep({"name": "serve: ready", "seconds": round(time.monotonic() - begun, 1)})

        def clip(name: str, steps: int, seed: int) -> None:
            begun = time.monotonic()
            answer = http.post("/simulate", json=body(steps, seed))
            found = answer.json()
            row: Row = {"name": name, "seconds": round(time.monotonic() - begun, 2), "status": answer.status_code}
            good = ("type", "detail") if answer.is_error else ("timings",)
            keep(row | {key: found[key] for key in good})

        clip("serve: first clip", 3, 0)
        clip("serve: second clip", 3, 1)
        keep(canceled(http, body(200, 2)))
        clip("serve: after a cancel", 3, 3)
        if device.type == "cuda":
            free, _ = torch.cuda.mem_get_info(device)
            taken = torch.empty(max(0, int(free - ROOM)), dtype=torch.uint8, device=device)
            clip("serve: memory is taken", 3, 4)
            del taken
            torch.cuda.empty_cache()
            clip("serve: memory is free", 3, 5)
        memory = [line for line in http.get("/metrics").text.splitlines() if line.startswith("cow_gpu_memory")]
        keep({"name": "serve: metrics", "said": memory})


def canceled(http: httpx.Client, body: Row) -> Row:
    """A job is canceled in its denoising."""
    job = http.post("/simulate", json=body, headers={"Prefer": "respond-async"}).json()
    path, deadline = f"/jobs/{job['id']}", time.monotonic() + CLIP_SECONDS
    while time.monotonic() < deadline:
        now = http.get(path).json()
        if now["status"] not in {"queued", "running"} or now.get("stage") == "generation":
            break
        time.sleep(0.1)
    time.sleep(1)  # some steps
    begun = time.monotonic()
    http.post(f"{path}/cancel")
    while (now := http.get(path).json())["status"] not in {"canceled", "succeeded", "failed"}:
        if time.monotonic() > deadline:
            break
        time.sleep(0.02)
    return {"name": "serve: cancel", "status": now["status"], "seconds": round(time.monotonic() - begun, 2)}


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--toy", action="store_true", help="with the toy's sizes")
    parser.add_argument("--num-frames", type=int, default=33)
    parser.add_argument("--profile", action="append", help="by default all of them")
    parser.add_argument("--at-once", type=int, default=1, help="profiles")
    parser.add_argument("--serve", default="", help="profile of the server; by default exact, on a CPU portable")
    parser.add_argument("--json", type=Path, help="write the rows here")
    given = parser.parse_args()
    device = choose_device("auto", GeneratorUnavailable)
    rows: list[Row] = []
    writing = Mutex()

    def keep(row: Row) -> None:
        with writing:
            rows.append(row)
            print(json.dumps(row, ensure_ascii=False), flush=True)
            if given.json is not None:
                found = {"device": str(device), "torch": torch.__version__, "toy": given.toy, "rows": rows}
                given.json.write_text(json.dumps(found, indent=2, ensure_ascii=False) + "\n")

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        home, begun = Path(folder), time.monotonic()
        write_weights(home, given.toy, device)
        keep({"name": "weights", "seconds": round(time.monotonic() - begun, 1)})
        names = given.profile or [name for name in ATI.profiles if not name.startswith("exact-")]

        def try_out(name: str) -> None:
            keep(compared(home, simulate(home, name, given.num_frames)))

        try_out("portable")
        with ThreadPoolExecutor(given.at_once) as pool:
            list(pool.map(try_out, [name for name in names if name != "portable"]))
        try:
            profile = given.serve or ("portable" if device.type == "cpu" else "exact")
            over_http(home, profile, given.num_frames, device, keep)
        except (RuntimeError, httpx.HTTPError) as error:
            keep({"name": "serve", "failed": f"{type(error).__name__}: {error}"})
    return int(
        any(
            "failed" in row or row.get("exit", 0) != 0 or row.get("status", 200) not in (200, "canceled")
            for row in rows
        )
    )


if __name__ == "__main__":
    sys.exit(main())
