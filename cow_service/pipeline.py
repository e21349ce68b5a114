"""The pipeline: what happens to a request, stage by stage. The only file that names the stages in order."""

from __future__ import annotations

from cow_service.errors import Canceled, CowError, InvalidRequest, MllmUnavailable, ReaderUnavailable
from cow_service.readers.question.choices import choices_source, read_choices
from cow_service.records import Answer, Problem, Simulation
from cow_service.requests import AnswerRequest, SimulateRequest
from cow_service.stages.answering import answer_question
from cow_service.stages.generation import generate
from cow_service.stages.grounding import ground, use_stored_masks
from cow_service.stages.motion import read_motion
from cow_service.stages.run import Run
from cow_service.stages.trajectory import compute_trajectory


def simulate(run: Run[SimulateRequest]) -> Simulation:
    """Imagines the future of an image.

    Raises the errors of its stages: `InvalidRequest`, `CannotGround`, `CannotReadDirection`, `GeneratorUnavailable`,
    `Canceled`...
    """
    run.check_request()
    grounding = run.stage("grounding", ground)
    use_stored_masks(run, grounding)
    motion = run.stage("motion", read_motion, grounding, run.hints)
    trajectory = run.stage("trajectory", compute_trajectory, grounding, motion)
    clip = run.stage("generation", generate, grounding, motion, trajectory)
    return Simulation(
        id=run.simulation_id,
        created_at=run.created_at,
        question=run.request.question,
        image=run.image.info,
        grounding=grounding,
        motion=motion,
        trajectory=trajectory,
        frames=clip.frames,
        factual_frames=clip.factual_frames,
        video=clip.video,
        overlay=clip.overlay,
        generator=clip.generator,
        reader=run.reader_info("grounding", "motion"),
        usage=run.usage,
        timings=dict(run.timings),
        reused=tuple(run.reused),
        warnings=run.warnings("grounding", "motion", "trajectory"),
    )


def answer(run: Run[AnswerRequest]) -> Answer:
    """Imagines, unless the request says never, then answers.

    A simulation that fails does not lose the answer: it is then given from the image alone, with a warning.
    Raises `InvalidRequest`, `Canceled`, `ReaderUnavailable`, `MllmBadReply`, `MllmUnavailable`.
    """
    simulation, failure = _imagine(run) if run.request.imagine == "always" else (None, None)
    verdicts = run.stage("answering", answer_question, run.grounding, simulation)
    return Answer(
        **dict(verdicts.verdict),
        id=run.id,
        created_at=run.created_at,
        question=run.request.question,
        options=read_choices(run.request.question, run.request.options),
        options_source=choices_source(run.request.question, run.request.options),
        image=run.image.info,
        simulation=simulation,
        simulation_problem=None if failure is None else Problem(**failure.as_problem()),
        baseline=verdicts.baseline,
        reader=run.reader_info("grounding", "motion", "answering"),
        usage=run.usage,
        timings=dict(run.timings),
        reused=tuple(run.reused),
        warnings=(*_not_imagined(failure), *run.warnings("answering")),
    )


def _imagine(run: Run[AnswerRequest]) -> tuple[Simulation | None, CowError | None]:
    """The simulation, or the error for which there is none. Raises what leaves no answer either."""
    try:
        return simulate(run), None
    except (InvalidRequest, Canceled, MllmUnavailable, ReaderUnavailable):
        raise
    except CowError as error:
        return None, error


def _not_imagined(failure: CowError | None) -> tuple[str, ...]:
    if failure is None:
        return ()
    return (f"Nothing was imagined, the answer is from the image alone. {failure.code}: {failure.detail}",)
