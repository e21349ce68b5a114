"""Stage 4: the frames of the imagined future, chosen ones as pictures and all of them as video."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from cow_service.generators.base import GeneratorInput, Scene
from cow_service.generators.interventions import with_put, without_removed
from cow_service.media.artifacts import Put, disk_errors
from cow_service.media.images import encode_jpeg, encode_png, fit_within
from cow_service.media.overlay import DARK, LIGHT, Label, Replaced, draw_labels, draw_overlay
from cow_service.media.types import Image
from cow_service.perception.observation import Observation
from cow_service.records import Clip, Frame, GeneratorInfo, Grounding, Motion, Trajectory, Video
from cow_service.requests import FramesRequest, SimulateRequest
from cow_service.stages.grounding import look_again
from cow_service.stages.keys import StageResult
from cow_service.stages.run import Run
from cow_service.stages.seeing import obstacles_of


@dataclass(frozen=True)
class EncodedFrame:
    """A frame of the clip, and its PNG once that is made."""

    index: int
    time: float  # s
    width: int  # px
    height: int
    png: Future[bytes]

    @staticmethod
    def of(pixels: Image, index: int, fps: float, max_side: int | None, encoder: Executor) -> EncodedFrame:
        """Of an image [H, W, 3] that its maker may change afterwards."""
        small = fit_within(pixels, max_side)
        picture = pixels.copy() if small is pixels else small
        png = encoder.submit(lambda: encode_png(picture))
        return EncodedFrame(index, index / fps, picture.shape[1], picture.shape[0], png)


def stored(frames: Sequence[EncodedFrame], put: Put) -> tuple[Frame, ...]:
    """Waits for the PNGs and stores them."""
    kept = [put(frame.png.result(), "image/png") for frame in frames]
    return tuple(
        Frame(
            index=frame.index,
            time=frame.time,
            url=artifact.url,
            sha256=artifact.sha256,
            width=frame.width,
            height=frame.height,
        )
        for frame, artifact in zip(frames, kept, strict=True)
    )


TOY = "'{name}' has random weights: its frames mean nothing, and no answer may rest on them."
OVERLAY_SIDE = 1280  # px, at most
MIN_GAP = 0.2  # s between a contact and another chosen frame: closer ones show the same


def choose_frames(wanted: FramesRequest, trajectory: Trajectory) -> tuple[int, ...]:
    """Ascending clip indices of the frames to return, by the policy or as listed in the request.

    `initial` is every second frame after the first (1, 3, 5, ...), as in the paper's evaluation code; `uniform` spreads
    over the whole clip, both ends included; `events` takes the first moment that matters, the end of the motion and a
    frame before that moment, then further moments, then the frames that lie farthest from those already taken while
    the object is visible and something moves. Moments are the first frames of encounters, of what is asked about
    before others, and contacts.
    """
    last = trajectory.num_frames - 1
    if wanted.indices is not None:
        return tuple(sorted(set(wanted.indices)))
    count = min(wanted.count, last + 1)
    if wanted.policy == "initial":
        spread = [min(2 * i + 1, last) for i in range(count)]
        return tuple(sorted(set(spread))) if len(set(spread)) == count else tuple(range(last + 1))[:count]
    if wanted.policy == "uniform":
        return tuple(int(i) for i in np.linspace(0, last, count).round()) if count > 1 else (last,)
    # The first frames of encounters, then those after contacts, of which those between bodies come first.
    visible = trajectory.path.visible
    asked = None if trajectory.outcome is None else trajectory.outcome.object
    met = sorted(trajectory.encounters, key=lambda each: (each.object != asked, each.first_frame))
    moments = list(dict.fromkeys(each.first_frame for each in met if each.first_frame <= last))
    for contact in sorted(trajectory.contacts, key=lambda contact: (contact.b is None, contact.time)):
        frame = math.ceil(contact.time * trajectory.fps - 1e-6)
        is_apart = all(abs(frame - other) >= MIN_GAP * trajectory.fps for other in (0, *moments))
        if frame <= last and is_apart:
            moments.append(frame)
    moving = last if trajectory.moving_until is None else max(1, math.ceil(trajectory.moving_until * trajectory.fps))
    seen = [i for i in range(1, min(last, moving) + 1) if visible[i]] or list(range(1, last + 1))
    # The approach is shown even where everything happens early: a hit is understood by what led to it.
    story = [*moments[:1], seen[-1], *(moment // 2 for moment in moments[:1] if moment > 1), *moments[1:]]
    chosen = list(dict.fromkeys(story))[:count]
    # The rest where something is seen to move, else anywhere, far from one another.
    for pool in (seen, list(range(last + 1))):
        while len(chosen) < count and (left := [i for i in pool if i not in chosen]):
            chosen.append(max(left, key=lambda i: min(abs(i - j) for j in (*chosen, 0))))
    return tuple(sorted(chosen))


def generate(
    run: Run[SimulateRequest], grounding: Grounding, motion: Motion, trajectory: Trajectory
) -> StageResult[Clip]:
    """Renders the clip once, storing the chosen frames, the overlay and, where it is wanted, the video.

    Raises `InvalidRequest`, `GeneratorOutOfMemory`, `Canceled`.
    """
    with run.cpu():
        given, as_it_is = _inputs(run, grounding, motion, trajectory)
    made_by = run.generator.describe(given)
    with run.backends.artifacts.batch(run.retry_policy) as put, ThreadPoolExecutor(1) as encoder:
        with run.device():
            frames, video = _render(run, given, made_by, put, encoder)
            factual: list[EncodedFrame] = []
            # Those of the scene as it is cost as much as the clip: on a device, made only where they are asked for.
            wanted, is_cheap = run.request.frames, run.generator.concurrency is None
            if as_it_is is not None and (is_cheap if wanted.factual is None else wanted.factual):
                indices = [frame.index for frame in frames]
                pictures = run.generator.render(as_it_is, indices, run.report_share)
                factual = [
                    EncodedFrame.of(_marked(pixels, made_by), index, trajectory.fps, wanted.max_side, encoder)
                    for index, pixels in zip(indices, pictures, strict=True)
                ]
        with run.cpu():  # while the last frames are encoded
            overlay = put(_draw_overlay(run.image.pixels, given, as_it_is or given), "image/jpeg")
        kept, kept_factual = stored(frames, put), stored(factual, put)
    clip = Clip(frames=kept, factual_frames=kept_factual, video=video, overlay=overlay, generator=made_by)
    named = (*clip.frames, *clip.factual_frames, *([] if video is None else [video]), clip.overlay)
    warnings = (TOY.format(name=made_by.name),) if made_by.is_toy else ()
    return StageResult(value=clip, warnings=warnings, artifacts=tuple(each.sha256 for each in named))


def _marked(pixels: Image, made_by: GeneratorInfo) -> Image:
    """A frame [H, W, 3]; that of a toy says so itself, since pictures are passed on without their warnings."""
    if made_by.is_toy:
        pixels = pixels.copy()
        draw_labels(pixels, [Label("toy model", (0, 0, 0, 0), LIGHT, below=True)], 1.0, DARK)
    return pixels


def _inputs(
    run: Run[SimulateRequest], grounding: Grounding, motion: Motion, trajectory: Trajectory
) -> tuple[GeneratorInput, GeneratorInput | None]:
    """What the generator is given and, where something is changed first, what it is given for the scene as it is."""
    observation = look_again(run, grounding, motion.cue)
    obstacles, taken = obstacles_of(observation, grounding)
    scene = scene_of(observation, grounding, trajectory)
    options, seed, inpainter = run.generator_options, run.request.clip_seed, run.backends.perception.inpainter
    if trajectory.factual is None:
        given = GeneratorInput(scene, grounding, motion, trajectory, obstacles, seed, options, inpainter=inpainter)
        return given, None
    everything = (*obstacles, *taken)
    as_it_is = GeneratorInput(
        scene, grounding, motion, trajectory.factual, everything, seed, options, inpainter=inpainter
    )
    removed = range(len(obstacles) + 1, len(everything) + 1)
    given = without_removed(as_it_is, removed, trajectory) if taken else replace(as_it_is, trajectory=trajectory)
    return with_put(given, trajectory.factual), as_it_is


def scene_of(observation: Observation, grounding: Grounding, trajectory: Trajectory) -> Scene:
    """The picture that a clip begins with."""
    # Something that is put elsewhere may leave the air by that.
    begins = [each.bodies[0] for each in (trajectory, trajectory.factual) if each is not None and each.bodies]
    side_view, is_in_air = observation.side_view, any(body.support == "air" for body in begins)
    return Scene(
        image=observation.image,
        clean=observation.clean,
        cues=observation.cues,
        mover=observation.mask_in(grounding.bbox),
        shadow=observation.shadow_below(grounding.bbox) if is_in_air and trajectory.light is None else None,
        backdrop=None if side_view is None else side_view.empty,
    )


def _draw_overlay(image: Image, given: GeneratorInput, as_it_is: GeneratorInput) -> bytes:
    """The overlay over the input image [H, W, 3], as JPEG."""
    grounding, trajectory = given.grounding, given.trajectory
    mover = (as_it_is if given.before is None else given).scene.mover.full()
    gone = as_it_is.obstacles[len(given.obstacles) :]
    placed: list[Replaced] = []
    for each in trajectory.placed:
        (old_bbox, old), (bbox, mask) = (
            (there.obstacles[each.body - 1].bbox, there.obstacles[each.body - 1].mask.full())
            if each.body
            else (there.grounding.bbox, there.scene.mover.full())
            for there in (as_it_is, given)
        )
        placed.append(Replaced(each.object, each.place, old_bbox, old, bbox, mask))
    removed = [(each.name, each.bbox, each.mask.full()) for each in gone]
    return encode_jpeg(
        draw_overlay(image, grounding, given.motion, trajectory, mover, removed, placed, max_side=OVERLAY_SIDE)
    )


def _render(
    run: Run[SimulateRequest], given: GeneratorInput, made_by: GeneratorInfo, put: Put, encoder: Executor
) -> tuple[list[EncodedFrame], Video | None]:
    """The chosen frames, and the video of all of them. Only those that are needed are rendered."""
    generator, request, trajectory = run.generator, run.request, given.trajectory
    chosen = choose_frames(request.frames, trajectory)
    indices = tuple(range(trajectory.num_frames)) if request.video else chosen
    frames: list[EncodedFrame] = []

    def clip() -> Iterator[Image]:
        for index, rendered in zip(indices, generator.render(given, indices, run.report_share), strict=True):
            pixels = _marked(rendered, made_by)
            if index in chosen:
                frames.append(EncodedFrame.of(pixels, index, trajectory.fps, request.frames.max_side, encoder))
            yield pixels

    if not request.video:
        for _ in clip():
            pass
        return frames, None

    from cow_service.media.video import write_mp4  # noqa: PLC0415 # FFmpeg's bindings take long to import

    width, height = generator.size(given.scene.width, given.scene.height)
    with run.backends.artifacts.scratch() as path:
        count = write_mp4(clip(), path, fps=trajectory.fps, width=width, height=height)
        with disk_errors():
            data = path.read_bytes()
        artifact = put(data, "video/mp4")
    return frames, Video(
        url=artifact.url,
        sha256=artifact.sha256,
        fps=trajectory.fps,
        num_frames=count,
        width=width + width % 2,
        height=height + height % 2,
    )
