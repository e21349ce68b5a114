"""What memory a job will need, known before its image is decoded, and how much all jobs of a server may take."""

from cow_service.errors import CowError
from cow_service.jobs.computing import Work
from cow_service.media.artifacts import ArtifactStore
from cow_service.media.images import pixels_in
from cow_service.settings import WORKER_BYTES, Settings

# Of a job, beside what a worker takes for small images. `benchmarks/memory.py` measures the kinds of pictures: with a
# depth map a job takes most, at 24 megapixels 450 MB.
BYTES_PER_PIXEL, BYTES_PER_PIXEL_OF_A_MASK = 12, 2
CLIP_SIDE = 1280  # px: frames are no larger


def memory_for_jobs(settings: Settings) -> int:
    """Bytes that all jobs may take beside the server and its workers; at least 1, so that a job can run alone."""
    return max(1, int(settings.memory - (settings.concurrency + 1) * WORKER_BYTES))


def memory_needed(work: Work, artifacts: ArtifactStore, settings: Settings) -> int:
    """Bytes that a job will take; those of the largest image where its own cannot be read."""
    spec = work.job.spec
    try:
        pixels = pixels_in(artifacts.read(spec.image))
    except CowError:  # as the worker will find
        pixels = int(settings.max_image_megapixels * 1e6)
    request, of_masks = spec.parsed(), BYTES_PER_PIXEL_OF_A_MASK * len(spec.attached)
    frames = (len(request.frames.indices or ()) or request.frames.count) * (2 if request.interventions else 1)
    side = min(request.frames.max_side or CLIP_SIDE, CLIP_SIDE)
    return pixels * (BYTES_PER_PIXEL + of_masks) + frames * 3 * min(pixels, side**2)
