"""One model, built once, that is put into each form whose passes are measured."""

from __future__ import annotations

import resource
from typing import Any

import torch
from torch import Tensor, nn
from wan_flops import pass_flops
from wan_models import Case, Clock, build, empty_parts, fill, film_tracks, time_parts
from wan_result import rounded

from cow_service.generators.wan.acceleration import accelerate, accelerate_transformer, reset_cache
from cow_service.generators.wan.checkpoints import IN_CHANNELS, TEXT_LENGTH
from cow_service.generators.wan.pipeline import compose, image_token_count, latent_shape
from cow_service.generators.wan.profiles import Acceleration, Profile, profile_of
from cow_service.generators.wan.tiny import make_tiny

SHORT_FRAMES = 17, 9  # of a second size
KERNELS = 15
NAME_LENGTH = 90  # characters of a kernel's


class Bench:
    """The parts of a model on their device. Not one method leaves another form behind than it found, but `put`."""

    def __init__(self, case: Case, peak: float) -> None:
        """`peak`: FLOP/s of matrix products in bfloat16."""
        self.case, self.peak = case, peak
        self.clock = Clock(case.device)
        self._form: Acceleration | None = Acceleration()  # None while it is being changed
        dtype = "bfloat16" if case.device.type == "cuda" else "float32"
        self._plain = Profile(summary="", sampling=profile_of(case.manifest, "exact").sampling, dtype=dtype)
        begun = self.clock.now()
        self.pipeline = build(case, self._plain)
        self.built = self.clock.now() - begun  # seconds
        self._transformer: Any = self.pipeline.transformer
        self._eager: dict[tuple[int, int], Tensor] = {}  # what passes gave first, by frames and seed
        time_parts(self.pipeline, self.clock)

    def put(self, form: Acceleration) -> None:
        """Has the transformer run in another way from now on; what was compiled before is reused."""
        if form == self._form:
            return
        self._form = None
        if self._transformer.is_cache_enabled:
            self._transformer.disable_cache()
        for block in self._transformer.blocks:
            vars(block).pop("forward", None)  # the compiled one
        accelerate_transformer(self._transformer, form, self.case.device)
        self._form = form

    def passes(self, count: int = 2, num_frames: int | None = None, batch: int = 1) -> dict[str, Any]:
        """Seconds of that many passes, one after the other, for clips of some length; and the result of the last one.

        `off_eager`: its relative distance from what the first form gave for the same inputs, which is the eager one.
        """
        frames = num_frames or self.case.num_frames
        reset_cache(self._transformer)
        self._forget_peak()
        # Other inputs each time: a cache finds no change between two passes that are the same.
        done = [self._pass(self._inputs(frames, batch, seed)) for seed in range(count)]
        seconds, found = [each for each, _ in done], done[-1][1][:1]
        eager = self._eager.setdefault((frames, count - 1), found) if batch == 1 else found
        flops = batch * pass_flops(
            self.case.manifest.architecture, frames, self.case.width, self.case.height, self._image_tokens
        )
        return {
            "pass_s": [rounded(each) for each in seconds],
            "off_eager": rounded(float((found - eager).norm() / eager.norm())),
            "tflops": rounded(flops / seconds[-1] / 1e12),
            "share_of_peak": rounded(flops / seconds[-1] / self.peak),
            **self._peaks(),
        }

    def compiled(self) -> dict[str, Any]:
        """The first pass of a size, which compiles, and the next; of a second size; of the first size again.

        What `dynamic=True` would cost is told by the operations per second of its code, at a size of nearly as many.
        """
        short = next(frames for frames in SHORT_FRAMES if frames != self.case.num_frames)
        first, second, again = self.passes(), self.passes(num_frames=short), self.passes(1)
        near = self.passes(1, num_frames=self.case.num_frames - 4)  # runs the code for any size
        return {
            "cold_s": first["pass_s"][0],
            **first,
            "pass_s": [first["pass_s"][1], *again["pass_s"]],
            "second_size_cold_s": second["pass_s"][0],
            "second_size_s": second["pass_s"][1],
            "any_size_tflops": near["tflops"],
        }

    def cached(self) -> dict[str, Any]:
        """The second of two passes: with a cache that compares and skips nothing, and one that skips all it can."""
        found: dict[str, Any] = {}
        before = self._form
        assert before is not None
        for name, threshold in (("at_cost", 0.0), ("at_skip", 1e9)):
            self.put(before.model_copy(update={"cache": "first-block", "cache_threshold": threshold}))
            found[f"{name}_s"] = self.passes()["pass_s"][1]
            found |= {f"{name}_{peak}": value for peak, value in self._peaks().items()}
        self.put(before)
        return found

    def both_guidance_passes(self) -> dict[str, Any]:
        """A step's two passes one after the other, and in one batch, each by code for its own shape."""
        two = self.passes(2)
        torch.compiler.reset()  # else the batch would be taken for one more size, and compiled for any
        one = self.passes(2, batch=2)
        seconds = sum(two["pass_s"]), one["pass_s"][-1]
        peaks = {f"{way}_{name}": found[name] for way, found in (("two", two), ("one", one)) for name in self._peaks()}
        return {"two_passes_s": rounded(seconds[0]), "one_batch_s": seconds[1],
                "two_over_one": rounded(seconds[0] / seconds[1]), **peaks}  # fmt: skip

    def kernels(self) -> dict[str, Any]:
        """Where the time of one pass goes: kernels of a GPU, operations of a CPU."""
        from torch.autograd import DeviceType  # noqa: PLC0415
        from torch.profiler import ProfilerActivity, profile  # noqa: PLC0415

        on_gpu = self.case.device.type == "cuda"
        given = self._inputs(self.case.num_frames, 1)
        reset_cache(self._transformer)
        self._pass(given)
        with profile(activities=[ProfilerActivity.CPU, *([ProfilerActivity.CUDA] if on_gpu else [])]) as profiled:
            self._pass(given)
        events: list[tuple[float, int, str]] = sorted(
            (
                ((each.self_device_time_total if on_gpu else each.self_cpu_time_total) / 1e3, each.count, each.key)
                for each in profiled.key_averages()
                if (each.device_type == DeviceType.CUDA) == on_gpu
                and not each.is_user_annotation  # a compiled graph's name, around its kernels
            ),
            reverse=True,
        )
        total = sum(ms for ms, _, _ in events)
        return {
            "all_ms": rounded(total),
            "kernels": [
                {"name": name[:NAME_LENGTH], "ms": rounded(ms), "share": rounded(ms / total), "calls": count}
                for ms, count, name in events[:KERNELS]
            ],
        }

    @torch.no_grad()
    def vae(self, dtype: torch.dtype, *, channels_last: bool = False, tiled: bool = False) -> dict[str, Any]:
        """Encoding the first frame of a clip, with the empty frames after it, and decoding all of them."""
        vae: Any = self.pipeline.vae
        case, before = self.case, next(vae.parameters()).dtype
        _lay_out(vae, dtype, channels_last=channels_last)
        if tiled:
            vae.enable_tiling()
        try:
            found: dict[str, Any] = {}
            video = torch.zeros(1, 3, case.num_frames, case.height, case.width, device=case.device, dtype=dtype)
            latents = torch.randn(latent_shape(case.width, case.height, case.num_frames), device=case.device).to(dtype)
            for name, work in (("encode", lambda: vae.encode(video)), ("decode", lambda: vae.decode(latents))):
                self._forget_peak()
                begun = self.clock.now()
                work()
                found[f"{name}_s"] = rounded(self.clock.now() - begun)
                found |= {f"{name}_{peak}": value for peak, value in self._peaks().items()}
            return found
        finally:
            vae.disable_tiling()
            vae.clear_cache()
            _lay_out(vae, before, channels_last=False)

    def clip(self, profile: str) -> dict[str, Any]:
        """One whole clip by a profile's sampling and its VAE's precision, and the form that the transformer has."""
        wanted, vae = profile_of(self.case.manifest, profile), self.pipeline.vae
        before = next(vae.parameters()).dtype
        _lay_out(vae, getattr(torch, wanted.vae_dtype), channels_last=False)
        self.clock.parts.clear()
        reset_cache(self._transformer)
        self._forget_peak()
        begun = self.clock.now()
        try:
            moments = film_tracks(self.pipeline, self.case, self.clock, wanted.sampling)
        finally:
            _lay_out(vae, before, channels_last=False)
        total = self.clock.now() - begun
        parts = {**self.clock.parts, "denoising": moments[-1] - moments[0]}
        parts["other"] = total - sum(parts.values())
        return {
            "steps": wanted.sampling.steps,
            "total_s": rounded(total),
            "parts_s": {name: rounded(seconds) for name, seconds in parts.items()},
            **self._peaks(),
        }

    def offloaded(self) -> dict[str, Any]:
        """Pins the weights of a new transformer, block by block, and runs it. The old one is gone."""
        self._form = Acceleration()
        self.pipeline.transformer = self._transformer = None
        for encoder in (self.pipeline.text_encoder, self.pipeline.image_encoder):  # they would be in the GPU's peak
            encoder.to("cpu")
        self._transformer = self._new_transformer()
        parts = dict.fromkeys(("vae", "text_encoder", "image_encoder", "tokenizer", "image_processor"))
        begun = self.clock.now()
        accelerate(compose(transformer=self._transformer, **parts), Acceleration(offload="group"), self.case.device)
        pinned = self.clock.now() - begun
        return {"pinning_s": rounded(pinned), **self.passes(), "host_peak_gb": host_peak()}

    def _new_transformer(self) -> nn.Module:
        """On the CPU."""
        if self.case.toy:
            return make_tiny(self.case.manifest.architecture).transformer
        made = empty_parts(self.case.manifest)["transformer"]
        dtype = getattr(torch, self._plain.dtype)
        fill(made, dtype, self.case.device, torch.device("cpu"), made._keep_in_fp32_modules)
        return made.eval().requires_grad_(False)

    @property
    def _image_tokens(self) -> int:
        return image_token_count(self.pipeline.image_encoder)

    def _inputs(self, num_frames: int, batch: int, seed: int = 0) -> dict[str, Tensor]:
        config, device, dtype = self._transformer.config, self.case.device, self._transformer.dtype
        drawn = torch.Generator(device).manual_seed(seed)
        size = latent_shape(self.case.width, self.case.height, num_frames)[2:]

        def random(*shape: int) -> Tensor:
            return torch.randn(batch, *shape, generator=drawn, device=device).to(dtype)

        return {
            "hidden_states": random(IN_CHANNELS, *size),
            "timestep": torch.full((batch,), 500.0, device=device),
            "encoder_hidden_states": random(TEXT_LENGTH, config.text_dim),
            "encoder_hidden_states_image": random(self._image_tokens, config.image_dim),
        }

    @torch.no_grad()
    def _pass(self, given: dict[str, Tensor]) -> tuple[float, Tensor]:
        begun = self.clock.now()
        with self._transformer.cache_context("cond"):
            found = self._transformer(**given, return_dict=False)[0]
        return self.clock.now() - begun, found.float().cpu()

    def _forget_peak(self) -> None:
        if self.case.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.case.device)

    def _peaks(self) -> dict[str, float]:
        if self.case.device.type != "cuda":
            return {}
        return {"peak_gb": rounded(torch.cuda.max_memory_allocated(self.case.device) / 1e9)}


def _lay_out(vae: nn.Module, dtype: torch.dtype, *, channels_last: bool) -> None:
    nn.Module.to(vae, dtype)  # diffusers' own warns of modules that stay in float32, but the VAE has none
    layout = torch.channels_last_3d if channels_last else torch.contiguous_format
    for module in vae.modules():
        if isinstance(module, nn.Conv3d):
            module.weight.data = module.weight.data.contiguous(memory_format=layout)


def host_peak() -> float:
    """GB of the machine's memory that this process had at most."""
    return rounded(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9)
