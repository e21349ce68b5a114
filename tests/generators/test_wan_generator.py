"""The video generators at toy size: the whole way, its cancellation, its failures, and what is not done twice."""

from __future__ import annotations

import base64
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Example, example

from cow_service.errors import (
    Canceled,
    CowError,
    DeviceFailed,
    GeneratorOutOfMemory,
    GeneratorUnavailable,
    InvalidRequest,
)
from cow_service.generators.wan.generator import WanGenerator
from cow_service.generators.wan.memory import wait_until_done
from cow_service.generators.wan.pipeline import WanTrackPipeline
from cow_service.generators.wan.profiles import profile_of
from cow_service.records import Simulation
from cow_service.requests import SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings, SettingsError
from cow_service.weights.manifests import load_manifests

pytestmark = pytest.mark.slow

BALL = example("ball-and-mug")
SHORT = {"num_frames": 17, "frames": {"indices": list(range(17)), "max_side": None}}


def body(scene: Example = BALL, **rest: object) -> dict[str, object]:
    encoded = "data:image/jpeg;base64," + base64.b64encode(scene.image).decode()
    return {"image": encoded, "question": scene.meta["question"], "generator": "tiny-ati", **SHORT, **rest}


@pytest.fixture(scope="module")
def toys(tmp_path_factory: pytest.TempPathFactory) -> Service:
    """One service for all: to make its models takes seconds."""
    return Service(Settings(data_dir=tmp_path_factory.mktemp("toys")))


def simulate(service: Service, progress: Callable[[str, float], None] | None = None, **rest: object) -> Simulation:
    listener = progress or (lambda stage, done: None)
    return service.simulate(SimulateRequest.model_validate(body(**rest)), listener)


def pipeline_of(service: Service, name: str = "tiny-ati") -> WanTrackPipeline:
    generator = service.generators.get(name)
    assert isinstance(generator, WanGenerator)
    return generator.pipeline


def pictures(simulation: Simulation) -> list[str]:
    return [frame.sha256 for frame in simulation.frames]


RATES = {"tiny-ati": (16, 17), "tiny-wan-move": (16, 17), "tiny-refine": (24, 25)}  # and lengths, of the models' clips


@pytest.mark.parametrize("name", RATES)
def test_frames_and_video(toys: Service, name: str) -> None:
    found = simulate(toys, generator=name)
    assert found.video is not None
    assert (found.video.num_frames, found.video.width % 16, found.video.height % 16) == (17, 0, 0)
    assert found.frames[0].width / found.frames[0].height == pytest.approx(832 / 480, rel=0.2)
    assert len(set(pictures(found))) > 8  # it moves
    info = found.generator
    assert (info.name, info.steps, info.seed) == (name, 3 if name == "tiny-refine" else 4, 0)
    assert info.options["prompt"] == (
        "The yellow ball rolls to the right and hits and pushes the blue mug after about 0.8 s. The camera stays still."
    )
    assert (info.options["fps"], info.options["num_frames"]) == RATES[name]
    assert info.options["profile"] == "exact"


def test_the_seed_decides(toys: Service) -> None:
    first, again, other = (simulate(toys, seed=seed) for seed in (3, 3, 4))
    assert pictures(first) == pictures(again)
    assert first.video == again.video
    assert pictures(first) != pictures(other)


def test_what_was_asked_for_changes_the_frames(toys: Service) -> None:
    """Each input of the model reaches it."""
    plain = pictures(simulate(toys, video=False))
    for change in (
        {"generator": "tiny-wan-move"},
        {"motion": {"direction": [0, -1]}},
        {"generator_options": {"prompt": "something else"}},
        {"generator_options": {"negative_prompt": "something else"}},
        {"generator_options": {"guidance_scale": 1.0}},
        {"generator_options": {"shift": 3.0}},
        {"generator_options": {"steps": 3}},
        {"generator_options": {"clean_cues": False}},
    ):
        assert pictures(simulate(toys, video=False, **change)) != plain, change


def test_options_are_recorded(toys: Service) -> None:
    found = simulate(toys, video=False, generator_options={"steps": 2, "shift": 3.0, "negative_prompt": "blur"})
    assert found.generator.steps == 2
    assert found.generator.options["shift"] == 3.0
    assert found.generator.options["negative_prompt"] == "blur"


@pytest.mark.parametrize(
    ("change", "pointer", "said"),
    [
        ({"num_frames": 85, "frames": {}}, "/num_frames", "85 frames at 16 per second; take 81 (5 s)"),
        ({"num_frames": 155, "fps": 30, "frames": {}}, "/num_frames", "take 151 (5 s)"),
        (
            {"generator_options": {"coarse_strength": 2}},
            "/generator_options/coarse_strength",
            "less than or equal to 1",
        ),
        ({"generator_options": {"steps": 0}}, "/generator_options/steps", "greater than or equal to 1"),
        ({"generator_options": {"steps": "3"}}, "/generator_options/steps", "valid integer"),
        ({"generator_options": {"speed": 1}}, "/generator_options/speed", "not permitted"),
    ],
)
def test_what_it_cannot_make_is_refused_before_any_work(
    toys: Service, change: dict[str, object], pointer: str, said: str
) -> None:
    heard: list[str] = []
    with pytest.raises(InvalidRequest) as caught:
        simulate(toys, lambda stage, done: heard.append(stage), **change)
    assert not heard
    assert [(error.pointer, said in error.detail) for error in caught.value.errors] == [(pointer, True)]


def test_progress_after_every_step(toys: Service) -> None:
    heard: list[float] = []
    simulate(toys, lambda stage, done: heard.append(done) if stage == "generation" else None, video=False)
    assert heard == sorted(heard)
    assert [round(done, 3) for done in heard if 0 < done < 0.95] == [0.225, 0.45, 0.675, 0.9]
    assert heard[-1] == 1


def test_a_step_is_told_when_the_device_has_done_it(toys: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[str] = []
    monkeypatch.setattr("cow_service.generators.wan.pipeline.wait_until_done", lambda device: heard.append("done"))
    simulate(toys, lambda stage, done: heard.append("told") if stage == "generation" and 0 < done < 0.95 else None)
    assert heard == ["done", "told"] * 4


def test_a_gpu_is_waited_for_by_an_event(monkeypatch: pytest.MonkeyPatch) -> None:
    """There is no GPU here: its event and stream are fakes."""
    heard: list[object] = []

    class Event:
        def record(self, stream: object) -> None:
            heard.append(stream)

        def synchronize(self) -> None:
            heard.append("waited")

    monkeypatch.setattr(torch.cuda, "Event", Event)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: f"stream of {device}")
    wait_until_done(torch.device("cpu"))
    wait_until_done(torch.device("cuda", 0))
    assert heard == ["stream of cuda:0", "waited"]


def test_wan_move_has_the_noise_schedule_of_its_public_code_at_480p() -> None:
    for name, shift in (("wan-move", 3.0), ("ati", 5.0)):
        manifest = load_manifests()[name]
        shifts = {profile: profile_of(manifest, profile).sampling.shift for profile in manifest.profiles}
        assert {shifts.pop(distilled) for distilled in ("turbo", "small-turbo")} == {5.0}  # as its LoRA was distilled
        assert set(shifts.values()) == {shift}


def count(monkeypatch: pytest.MonkeyPatch, pipeline: WanTrackPipeline, *names: str) -> dict[str, int]:
    """How often methods of the pipeline are called."""
    calls = dict.fromkeys(names, 0)
    for name in names:
        method = getattr(pipeline, name)

        def counted(*args: object, _name: str = name, _method: Any = method, **given: object) -> object:
            calls[_name] += 1
            return _method(*args, **given)

        monkeypatch.setattr(pipeline, name, counted)
    return calls


def test_a_cancel_takes_effect_within_one_step(toys: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline = pipeline_of(toys)
    calls = count(monkeypatch, pipeline, "decode")
    passes: list[int] = []
    hook = pipeline.transformer.register_forward_hook(lambda *_: passes.append(1))

    def cancel(stage: str, done: float) -> None:
        if stage == "generation" and done > 0.4:  # after the second of four steps
            raise Canceled("The caller went away.")

    try:
        with pytest.raises(Canceled):
            simulate(toys, cancel)
    finally:
        hook.remove()
    assert len(passes) == 4  # two steps, guided and plain
    assert calls["decode"] == 0
    assert len(simulate(toys, video=False).frames) == 17  # the device is free again


def test_text_and_image_are_encoded_once(toys: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    simulate(toys, video=False)
    calls = count(monkeypatch, pipeline_of(toys), "encode_prompt", "embed_image")
    simulate(toys, video=False, seed=7, motion={"direction": [0.3, 1]}, generator_options={"prompt": "new words"})
    assert calls == {"encode_prompt": 1, "embed_image": 0}
    simulate(toys, video=False, num_frames=13, frames={})
    assert calls["embed_image"] == 1


def test_running_out_of_memory(toys: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    """A real allocation that no machine can serve, in the middle of a step; afterwards all is as before."""
    before = pictures(simulate(toys, video=False))
    pipeline = pipeline_of(toys)

    def too_much(module: torch.nn.Module, args: object, output: object) -> None:
        torch.empty(2**50, dtype=torch.float64)

    hook = pipeline.transformer.register_forward_hook(too_much)
    calls = count(monkeypatch, pipeline, "embed_image")
    try:
        with pytest.raises(GeneratorOutOfMemory, match="A clip of 17 frames at 112 x 64 does not fit") as caught:
            simulate(toys, video=False)
    finally:
        hook.remove()
    assert caught.value.code == "generator-out-of-memory"
    assert caught.value.__cause__ is None  # no traceback that holds the tensors
    assert pictures(simulate(toys, video=False)) == before
    assert calls["embed_image"] == 1  # the cached value had been released


def test_a_gpu_that_fails(toys: Service) -> None:
    """PyTorch's own error for it, in the middle of a step."""

    def fail(module: torch.nn.Module, args: object, output: object) -> None:
        raise torch.AcceleratorError("CUDA error: unspecified launch failure\nCompile with `TORCH_USE_CUDA_DSA`.")

    hook = pipeline_of(toys).transformer.register_forward_hook(fail)
    try:
        with pytest.raises(DeviceFailed, match=r"failed \(CUDA error: unspecified launch failure\)\. .*nvidia-smi"):
            simulate(toys, video=False)
    finally:
        hook.remove()


def test_other_failures_pass_through(toys: Service) -> None:
    def fail(module: torch.nn.Module, args: object, output: object) -> None:
        raise RuntimeError("something else")

    hook = pipeline_of(toys).transformer.register_forward_hook(fail)
    try:
        with pytest.raises(RuntimeError, match="something else"):
            simulate(toys, video=False)
    finally:
        hook.remove()


def test_one_clip_at_a_time(toys: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    """Several at once give what each gives alone; one that waits can be given up."""
    alone = {seed: pictures(simulate(toys, video=False, seed=seed)) for seed in (0, 1, 2)}
    pipeline = pipeline_of(toys)
    at_once, most = 0, 0
    denoise = pipeline.denoise

    def watched(*args: object) -> torch.Tensor:
        nonlocal at_once, most
        at_once += 1
        most = max(most, at_once)
        try:
            return denoise(*args)  # pyright: ignore[reportArgumentType]
        finally:
            at_once -= 1

    monkeypatch.setattr(pipeline, "denoise", watched)
    found: dict[int, list[str]] = {}
    threads = [
        threading.Thread(
            target=lambda seed=seed: found.update({seed: pictures(simulate(toys, video=False, seed=seed))})
        )
        for seed in alone
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == alone
    assert most == 1


def test_one_that_waits_can_be_given_up(toys: Service) -> None:
    pipeline = pipeline_of(toys)
    inside, go_on = threading.Event(), threading.Event()

    def hold(module: torch.nn.Module, args: object, output: object) -> None:
        inside.set()
        go_on.wait(30)

    def give_up(stage: str, done: float) -> None:
        if stage == "generation":
            raise Canceled("Not wanted any more.")

    hook = pipeline.transformer.register_forward_hook(hold)
    holder = threading.Thread(target=lambda: simulate(toys, video=False))
    holder.start()
    try:
        assert inside.wait(30)
        with pytest.raises(Canceled):
            simulate(toys, give_up, video=False)
        assert holder.is_alive()
    finally:
        go_on.set()
        holder.join()
        hook.remove()


def test_a_moved_track_moves_the_condition(toys: Service) -> None:
    """Features of the object's first place stand along its path in the guided condition, and nowhere else."""
    seen: list[torch.Tensor] = []
    hook = pipeline_of(toys).transformer.register_forward_pre_hook(
        lambda module, args, kwargs: seen.append(kwargs["hidden_states"][0, 16:20].clone()), with_kwargs=True
    )
    path = {"points": [[208, 240], [624, 240]], "fps": 1, "anchors": [], "tracks": [[[208, 240], [624, 240]]]}
    try:
        simulate(toys, video=False, fps=16, trajectory=path, grounding={"bbox": [188, 220, 228, 260]})
    finally:
        hook.remove()
    mask = seen[0][0].numpy()  # [T, h, w]
    assert (mask[0] == 1).all()
    columns = np.array([(mask[t] * np.arange(mask.shape[2])).sum() / mask[t].sum() for t in range(1, 5)])
    # Latent frame t takes clip frames 4t - 3 to 4t, and ATI's grid has its first and last cell at the image's edges.
    middle = np.array([np.mean([208 + 416 * f / 16 for f in range(4 * t - 3, 4 * t + 1)]) for t in range(1, 5)])
    np.testing.assert_allclose(columns, middle / 832 * (mask.shape[2] - 1), atol=0.5)


def kept_states(pipeline: WanTrackPipeline) -> int:
    """How many states the step cache's hooks hold, whose tensors are as large as hidden states."""
    registries = [getattr(module, "_diffusers_hook", None) for module in pipeline.transformer.modules()]
    hooks = [hook for registry in registries if registry is not None for hook in registry.hooks.values()]
    return sum(len(hook.state_manager._state_cache) for hook in hooks if hasattr(hook, "state_manager"))


def test_parts_that_are_moved_one_by_one_leave_before_the_steps(toys: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    """The last encoder would stay on the GPU beside the transformer: its hook only knows the part before it."""
    made = toys.generators.get("tiny-ati")
    assert isinstance(made, WanGenerator)
    pipeline, heard = pipeline_of(toys), list[str]()
    acceleration = made.profile.acceleration.model_copy(update={"offload": "model"})
    profile = made.profile.model_copy(update={"acceleration": acceleration})
    monkeypatch.setattr(made, "profile", profile)
    denoise, encode = pipeline.denoise, pipeline.encode_prompt
    monkeypatch.setattr(pipeline, "maybe_free_model_hooks", lambda: heard.append("freed"))
    monkeypatch.setattr(pipeline, "denoise", lambda *args: (heard.append("steps"), denoise(*args))[1])
    monkeypatch.setattr(pipeline, "encode_prompt", lambda **args: (heard.append("text"), encode(**args))[1])
    simulate(toys, video=False, generator_options={"prompt": "a text that was never encoded"})
    assert heard == ["text", "freed", "steps", "freed"]


def test_nothing_of_the_steps_is_kept_while_a_clip_is_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Service(Settings(data_dir=tmp_path, profile="fast", generator="tiny-ati")) as service:
        pipeline, held = pipeline_of(service), list[int]()
        decode, step = pipeline.decode, "cow_service.generators.wan.pipeline.wait_until_done"
        monkeypatch.setattr(step, lambda device: held.append(kept_states(pipeline)))
        monkeypatch.setattr(
            pipeline, "decode", lambda latents, dtype: (held.append(kept_states(pipeline)), decode(latents, dtype))[1]
        )
        simulate(service, video=False)
    assert held[0] > 0
    assert held[-1] == 0


class TestProfiles:
    @pytest.mark.parametrize("profile", ["fast", "turbo"])
    def test_they_make_a_clip(self, tmp_path: Path, profile: str) -> None:
        service = Service(Settings(data_dir=tmp_path, profile=profile))
        passes: list[int] = []
        pipeline_of(service).transformer.register_forward_hook(lambda *_: passes.append(1))
        found = simulate(service, video=False)
        assert found.generator.options["profile"] == profile
        assert len(passes) == (4 if profile == "turbo" else 8)
        assert found.generator.options["solver"] == ("euler" if profile == "turbo" else "unipc")
        assert pictures(found) == pictures(simulate(service, video=False))

    def test_one_that_there_is_not(self, tmp_path: Path) -> None:
        with pytest.raises(GeneratorUnavailable, match=r"no profile 'warp'\. It has: exact, exact-2, fast, turbo"):
            simulate(Service(Settings(data_dir=tmp_path, profile="warp")))

    def test_what_this_machine_cannot_do_is_said_at_load(self, tmp_path: Path) -> None:
        with pytest.raises(GeneratorUnavailable, match="no GPU 'cuda'"):
            Service(Settings(data_dir=tmp_path, device="cuda", generator="tiny-ati")).check()


@pytest.mark.parametrize("name", ["ati", "wan-move"])
def test_without_weights_it_says_how_to_get_them(tmp_path: Path, name: str) -> None:
    with pytest.raises(CowError, match=f"cow models pull {name}") as caught:
        simulate(Service(Settings(data_dir=tmp_path, profile="portable")), generator=name)
    assert caught.value.code == "weights-unavailable"


@pytest.mark.parametrize(
    ("size", "wanted"),
    [
        ((832, 480), (832, 480)),
        ((480, 832), (480, 832)),
        ((1024, 1024), (624, 624)),
        ((1086, 724), (768, 512)),
        ((4000, 30), (7296, 48)),
        ((8, 8), (624, 624)),
    ],
)
def test_the_size_of_a_clip(toys: Service, size: tuple[int, int], wanted: tuple[int, int]) -> None:

    generator = toys.generators.get("tiny-ati")
    assert isinstance(generator, WanGenerator)
    defaults = {**generator.manifest.defaults, "max_area": 480 * 832}
    full = replace(generator, manifest=generator.manifest.model_copy(update={"defaults": defaults}))
    assert full.size(*size) == wanted


def test_an_image_too_narrow_for_the_model(toys: Service) -> None:
    generator = toys.generators.get("tiny-ati")
    assert generator.size(8, 1_000) == (16, 1008)
    with pytest.raises(InvalidRequest, match="8 x 400000 px is too narrow") as caught:
        generator.size(8, 400_000)
    assert caught.value.errors[0].pointer == "/image"


def test_models_made_at_once_are_those_made_alone(tmp_path: Path) -> None:
    def weights(service: Service, name: str) -> torch.Tensor:
        return pipeline_of(service, name).transformer.proj_out.weight

    service, found = Service(Settings(data_dir=tmp_path)), {}
    names = ("tiny-ati", "tiny-wan-move")
    threads = [threading.Thread(target=lambda n=name: found.update({n: weights(service, n)})) for name in names]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert torch.equal(found["tiny-ati"], found["tiny-wan-move"])
    assert torch.equal(found["tiny-ati"], weights(Service(Settings(data_dir=tmp_path)), "tiny-ati"))


def test_the_whole_image_is_looked_at(toys: Service) -> None:
    """Also its outer fifths, which a square cut out of its middle would not have."""
    image = np.zeros((480, 832, 3), np.uint8)
    pipeline, found = pipeline_of(toys), []
    for left in (0, 255):
        image[:, :100] = left
        found.append(pipeline.embed_image(image, 112, 64, 5).embeds)
    assert not torch.allclose(found[0], found[1])


@pytest.mark.parametrize("name", ["tiny-ati", "tiny-wan-move"])
def test_what_each_pass_is_conditioned_on(toys: Service, name: str) -> None:
    """ATI: both on the tracks. Wan-Move: the guided pass alone."""
    seen: list[torch.Tensor] = []
    hook = pipeline_of(toys, name).transformer.register_forward_pre_hook(
        lambda module, args, kwargs: seen.append(kwargs["hidden_states"][0, 16:].clone()), with_kwargs=True
    )
    try:
        simulate(toys, video=False, generator=name)
    finally:
        hook.remove()
    guided, plain = seen[0], seen[1]
    assert torch.equal(guided, plain) == (name == "tiny-ati")
    frames = plain[4:, 1:]
    moved = guided[4:, 1:]
    assert name == "tiny-ati" or not torch.equal(moved, frames)
    # Wan-Move copies features of the first frame; the plain condition has none of them in later frames.
    first = guided[4:, 0].flatten(1).T
    copies = (moved.flatten(1).T[:, None] == first[None]).all(-1).any(1).sum()
    assert (copies > 0) == (name == "tiny-wan-move")


def test_a_checkpoint_for_a_model_that_takes_none(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"COW_CHECKPOINTS for 'tiny-ati': only for ati, .*wan-move"):
        Service(Settings(data_dir=tmp_path, checkpoints={"tiny-ati": tmp_path}))


def test_parts_of_ones_own_carry_no_pulled_revision(tmp_path: Path) -> None:
    """A whole pipeline of one's own brings its own other parts, whatever was pulled."""
    from cow_service.generators.wan.loading import Weights
    from cow_service.generators.wan.profiles import profile_of
    from cow_service.weights.manifests import load_manifests
    from cow_service.weights.repositories import Lock, folder_of, write_lock

    manifest = load_manifests()["ati"]
    profile = profile_of(manifest, "portable")
    for source in manifest.sources.values():
        folder_of(tmp_path / "models", source.repository).mkdir(parents=True)
        write_lock(tmp_path / "models", Lock(repository=source.repository, revision="a" * 40, patterns=(), files=()))
    (tmp_path / "whole" / "vae").mkdir(parents=True)
    (tmp_path / "one.safetensors").touch()
    for own, parts in (({}, ["base", "transformer"]), ("one.safetensors", ["base"]), ("whole", [])):
        checkpoints = {"ati": tmp_path / own} if own else {}
        settings = Settings(data_dir=tmp_path, checkpoints=checkpoints)
        assert sorted(Weights(manifest, profile, settings).revisions()) == parts


def test_what_a_generator_needs_is_told_by_its_manifest() -> None:
    """The class says the same, where its libraries are installed."""
    assert {load_manifests()[name].concurrency for name in ("ati", "wan-move", "tiny-ati")} == {
        WanGenerator.concurrency
    }
    assert load_manifests()["cutout"].concurrency is None
