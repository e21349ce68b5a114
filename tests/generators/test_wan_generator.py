"""The video generators at toy size: the whole way, its cancellation, its failures, and what is not done twice."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import Mock, call

import numpy as np
import pytest
from drawn import ball, floor
from filmed import CENTRE, RADIUS, RED, ignore, line, rolling, shot
from pydantic import ValidationError
from refusals import refused
from waiting import TIME_LIMIT

from cow_service.errors import Canceled
from cow_service.generators.base import GeneratorInput
from cow_service.generators.wan.profiles import WanOptions, profile_of
from cow_service.narration.story import shown
from cow_service.service import Service
from cow_service.settings import Settings, SettingsError
from cow_service.weights.manifests import load_manifests
from cow_service.weights.repositories import Lock, folder_of, write_lock

if TYPE_CHECKING:
    from cow_service.generators.wan.generator import WanGenerator

pytest_plugins = "toy_fixtures"
pytestmark = pytest.mark.slow

Frames = np.ndarray
FRAMES = 9  # of the scene


@pytest.fixture
def ati(made) -> WanGenerator:
    return made("tiny-ati")


def asked(given: GeneratorInput, seed: int = 0, **options: Any) -> GeneratorInput:
    return replace(given, seed=seed, options=WanOptions(**options))


def clip(
    made: WanGenerator, given: GeneratorInput, progress: Callable[[float], None] = ignore, seed: int = 0, **options: Any
) -> Frames:
    frames = range(given.trajectory.num_frames)
    return np.stack(list(made.render(asked(given, seed, **options), frames, progress)))


@pytest.mark.parametrize(
    ("name", "size", "rate"),
    [("tiny-ati", (112, 64), 16), ("tiny-wan-move", (112, 64), 16), ("tiny-refine", (96, 64), 24)],
)
def test_a_clip_and_who_makes_it(made, scene, name, size, rate) -> None:
    model = made(name)
    frames = clip(model, scene)
    assert frames.shape == (FRAMES, size[1], size[0], 3) == (FRAMES, *model.size(640, 400)[::-1], 3)
    assert len({frame.tobytes() for frame in frames}) > FRAMES // 2  # it moves
    strengths = {"coarse_strength": 0.25, "object_strength": 0.5} if name == "tiny-refine" else {}
    told = model.describe(asked(scene, seed=7))
    assert told.model_dump(exclude_defaults=True) == {
        "name": name,
        "seed": 7,
        "steps": 3 if name == "tiny-refine" else 4,
        "is_toy": True,
        "options": {
            "profile": "exact", "solver": "unipc", "shift": 5.0, "guidance_scale": 5.0, "dtype": "float32",
            "vae_dtype": "float32", "device": "cpu", "negative_prompt": "", "clean_cues": True, "fps": rate,
            "prompt": f"{shown('thing', scene.trajectory)} The camera stays still.",
            "num_frames": 9 if rate == 16 else 13, **strengths,
        },
    }  # fmt: skip
    own = {"shift": 3.0, "negative_prompt": "blur", "prompt": "a ball", "clean_cues": False}
    told = model.describe(asked(scene, steps=2, **own))
    assert told.options | own == told.options
    assert told.steps == (1 if name == "tiny-refine" else 2)
    unguided = model.describe(asked(scene, guidance_scale=1.0, negative_prompt="blur"))
    assert unguided.options["negative_prompt"] == "", "there is no pass that it would be for"


def test_what_was_asked_for_changes_the_frames_and_nothing_else_does(made, ati, scene) -> None:
    """Each input of the model reaches it."""
    plain = clip(ati, scene, seed=3)
    assert np.array_equal(clip(ati, scene, seed=3), plain)
    assert not np.array_equal(clip(ati, scene, seed=4), plain)
    assert not np.array_equal(clip(made("tiny-wan-move"), scene, seed=3), plain)
    words = "something else"
    changes: dict[str, Any] = {"prompt": words, "negative_prompt": words, "guidance_scale": 1.0, "shift": 3.0}
    for name, value in (changes | {"steps": 3, "object_strength": 0.5}).items():
        assert not np.array_equal(clip(ati, scene, seed=3, **{name: value}), plain), name


@pytest.mark.parametrize("bad", [{"coarse_strength": 2}, {"steps": 0}, {"steps": "3"}, {"speed": 1}, {"shift": 0}])
def test_options_that_make_no_sense_are_refused(bad: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        WanOptions(**bad)


def test_progress_is_told_when_the_device_has_done_a_step(ati, scene, monkeypatch) -> None:
    heard: list[float | str] = []
    monkeypatch.setattr("cow_service.generators.wan.memory.wait_until_done", lambda device: heard.append("done"))
    clip(ati, scene, lambda done: heard.append(round(done, 3)) if done else None)
    assert heard == ["done", 0.225, "done", 0.45, "done", 0.675, "done", 0.9, 1]
    heard.clear()
    clip(ati, scene, lambda done: heard.append(round(done, 3)) if done else None, steps=8, coarse_strength=0.5)
    assert heard == ["done", 0.225, "done", 0.45, "done", 0.675, "done", 0.9, 1]


def count(monkeypatch: pytest.MonkeyPatch, pipeline: Any, *names: str) -> list[str]:
    """Methods of the pipeline as they are called."""
    calls: list[str] = []
    for name in names:
        method = getattr(pipeline, name)

        def counted(*args: object, _name: str = name, _method: Any = method, **given: object) -> object:
            calls.append(_name)
            return _method(*args, **given)

        monkeypatch.setattr(pipeline, name, counted)
    return calls


def test_a_cancel_takes_effect_within_one_step(toys, ati, scene, monkeypatch) -> None:
    calls = count(monkeypatch, ati.pipeline, "decode")

    def cancel(done: float) -> None:
        if done > 0.4:  # after the second of four steps
            raise Canceled("The caller went away.")

    with toys.after_each_pass(ati, lambda: None) as passes, pytest.raises(Canceled):
        clip(ati, scene, cancel)
    assert len(passes) == 4  # two steps, guided and plain
    assert not calls
    assert len(clip(ati, scene)) == FRAMES  # the device is free again


def test_text_and_image_are_encoded_once_and_the_image_with_or_without_cues(ati, scene, monkeypatch) -> None:
    marked = np.zeros_like(scene.scene.image)
    drawn = replace(scene, scene=replace(scene.scene, image=marked))
    clip(ati, scene, steps=1)
    calls = count(monkeypatch, ati.pipeline, "encode_prompt", "embed_image")
    clip(ati, drawn, steps=1, seed=7, prompt="new words")
    assert calls == ["encode_prompt"]
    clip(ati, drawn, steps=1, prompt="new words", clean_cues=False)
    shorter = scene.trajectory.model_copy(update={"paths": rolling(5).trajectory.paths})
    clip(ati, replace(drawn, trajectory=shorter), steps=1, prompt="new words", clean_cues=False)
    assert calls == ["encode_prompt", "embed_image", "embed_image"]


def test_what_ends_in_the_middle_of_a_step_leaves_nothing(toys, ati, scene, monkeypatch) -> None:
    """A real allocation that no machine can serve; then PyTorch's own error of a GPU; then a fault of the code."""
    before = clip(ati, scene)
    calls = count(monkeypatch, ati.pipeline, "embed_image")
    too_much = partial(toys.torch.empty, 2**50, dtype=toys.torch.float64)
    with toys.after_each_pass(ati, too_much), refused("generator-out-of-memory") as caught:
        clip(ati, scene)
    assert all(each in caught.value.detail for each in ("9 frames", "112 x 64"))
    assert caught.value.__cause__ is None  # no traceback that holds the tensors
    assert np.array_equal(clip(ati, scene), before)
    assert calls == ["embed_image"], "the cached value had been released"

    def fail() -> None:
        raise faults.pop()

    gpu = toys.torch.AcceleratorError("CUDA error: unspecified launch failure\nCompile with `TORCH_USE_CUDA_DSA`.")
    faults = [RuntimeError("something else"), gpu]
    with toys.after_each_pass(ati, fail):
        with refused("device-failed") as caught:
            clip(ati, scene)
        assert "CUDA error: unspecified launch failure" in caught.value.detail
        assert "TORCH_USE_CUDA_DSA" not in caught.value.detail
        with pytest.raises(RuntimeError, match="something else"):
            clip(ati, scene)


def test_one_clip_at_a_time_and_one_that_waits_can_be_given_up(toys, ati, scene, monkeypatch) -> None:
    alone = clip(ati, scene)
    inside, go_on, found = threading.Event(), threading.Event(), list[Frames]()
    denoised = count(monkeypatch, ati.pipeline, "denoise")

    def hold() -> None:
        inside.set()
        go_on.wait(TIME_LIMIT)

    def give_up(done: float) -> None:
        raise Canceled("Not wanted any more.")

    thread = threading.Thread(target=lambda: found.append(clip(ati, scene)))
    with toys.after_each_pass(ati, hold):
        thread.start()
        try:
            assert inside.wait(TIME_LIMIT)
            with pytest.raises(Canceled):
                clip(ati, scene, give_up, seed=1)
            assert denoised == ["denoise"], "the other one waited"
        finally:
            go_on.set()
            thread.join()
    assert np.array_equal(found[0], alone)


def test_a_moved_track_moves_the_condition(toys, ati: WanGenerator) -> None:
    """Features of the object's first place stand along its path in the guided condition, and nowhere else."""
    filmed = shot(ball(floor(), CENTRE, RADIUS, RED), line(FRAMES, 40))
    given = replace(filmed, trajectory=filmed.trajectory.model_copy(update={"tracks_given": True}))
    with toys.after_each_pass(ati, lambda: None) as seen:
        clip(ati, given, steps=1)
    mask = seen[0][0].numpy()  # [T, h, w]
    assert (mask[0] == 1).all()
    columns = np.array([(each * np.arange(each.shape[1])).sum() / each.sum() for each in mask[1:]])
    # Latent frame t takes clip frames 4t - 3 to 4t, and ATI's grid has its first and last cell at the image's edges.
    middle = np.array([np.mean([160 + 40 * f for f in range(4 * t - 3, 4 * t + 1)]) for t in (1, 2)])
    np.testing.assert_allclose(columns, middle / 640 * (mask.shape[2] - 1), atol=0.5)


@pytest.mark.parametrize("name", ["tiny-ati", "tiny-wan-move"])
def test_what_each_pass_is_conditioned_on(toys, made, scene, name) -> None:
    """ATI: both on the tracks. Wan-Move: the guided pass alone, with features of the first frame copied."""
    with toys.after_each_pass(made(name), lambda: None) as seen:
        clip(made(name), scene, steps=1)
    guided, plain = seen
    assert guided.equal(plain) == (name == "tiny-ati")
    first = guided[4:, 0].flatten(1).T
    for condition, is_copied in ((guided, name == "tiny-wan-move"), (plain, False)):
        copies = (condition[4:, 1:].flatten(1).T[:, None] == first[None]).all(-1).any(1).sum()
        assert (copies > 0) == is_copied


def test_parts_that_are_moved_one_by_one_leave_before_the_steps(ati, scene, monkeypatch) -> None:
    """The last encoder would stay on the GPU beside the transformer: its hook only knows the part before it."""
    acceleration = ati.profile.acceleration.model_copy(update={"offload": "model"})
    monkeypatch.setattr(ati, "profile", ati.profile.model_copy(update={"acceleration": acceleration}))
    heard = count(monkeypatch, ati.pipeline, "maybe_free_model_hooks", "denoise", "encode_prompt")
    clip(ati, scene, prompt="a text that was never encoded")
    assert heard == ["encode_prompt", "maybe_free_model_hooks", "denoise", "maybe_free_model_hooks"]


def test_nothing_of_the_steps_is_kept_while_a_clip_is_decoded(toys, tmp_path: Path, scene, monkeypatch) -> None:
    fast = toys.model("tiny-ati", tmp_path, profile="fast")
    assert fast.describe(asked(scene)).options["cache"] == "first-block"
    before, held, decode = toys.hidden_states(), list[int](), fast.pipeline.decode

    def watched(*given: Any) -> Any:
        held.append(toys.hidden_states())
        return decode(*given)

    monkeypatch.setattr(fast.pipeline, "decode", watched)
    clip(fast, scene, lambda done: held.append(toys.hidden_states()) if done == 0.9 else None)
    assert held[0] > held[1] == before


def test_what_this_machine_cannot_do_is_said_at_load(toys, tmp_path: Path) -> None:
    for name, settings, code, named in (
        ("tiny-ati", {"profile": "warp"}, "generator-unavailable", "exact, exact-2, fast, turbo"),
        ("tiny-ati", {"device": "cuda"}, "generator-unavailable", "COW_DEVICE"),
        ("ati", {"profile": "portable"}, "weights-unavailable", "cow models pull ati"),
        ("wan-move", {"profile": "portable"}, "weights-unavailable", "cow models pull wan-move"),
    ):
        with refused(code) as caught:
            toys.model(name, tmp_path, **settings)
        assert named in caught.value.detail
    with pytest.raises(SettingsError, match="tiny-ati"):  # it takes no checkpoint
        Service(Settings(data_dir=tmp_path, checkpoints={"tiny-ati": tmp_path}))


def test_the_size_of_a_clip(ati) -> None:
    defaults = {**ati.manifest.defaults, "max_area": 480 * 832}
    full = replace(ati, manifest=ati.manifest.model_copy(update={"defaults": defaults}))
    sizes = {(832, 480): (832, 480), (480, 832): (480, 832), (1086, 724): (768, 512), (4000, 30): (7296, 48)}
    assert {size: full.size(*size) for size in sizes} == sizes
    assert ati.size(8, 1_000) == (16, 1008)
    with refused("invalid-request", "/image"):
        ati.size(8, 400_000)


def test_parts_of_ones_own_carry_no_pulled_revision(toys, tmp_path: Path) -> None:
    """A whole pipeline of one's own brings its own other parts, whatever was pulled."""
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
        assert sorted(toys.Weights(manifest, profile, settings).revisions()) == parts


def test_the_whole_image_is_looked_at(ati) -> None:
    """Also its outer fifths, which a square cut out of its middle would not have."""
    image = np.zeros((480, 832, 3), np.uint8)
    black = ati.pipeline.embed_image(image, 112, 64, 5).embeds
    image[:, :100] = 255
    assert not black.allclose(ati.pipeline.embed_image(image, 112, 64, 5).embeds)


def test_a_gpu_is_waited_for_by_an_event(toys, monkeypatch: pytest.MonkeyPatch) -> None:
    """There is no GPU here: its event and stream are fakes."""
    event = Mock()
    monkeypatch.setattr(toys.torch.cuda, "Event", lambda: event)
    monkeypatch.setattr(toys.torch.cuda, "current_stream", lambda device: f"stream of {device}")
    toys.wait_until_done(toys.CPU)
    assert event.mock_calls == []
    toys.wait_until_done(toys.torch.device("cuda", 0))
    assert event.mock_calls == [call.record("stream of cuda:0"), call.synchronize()]
