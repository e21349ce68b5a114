"""The pipeline: what happens to a request, stage by stage. `records.stages` lists them."""

from contextlib import nullcontext

from cow_service import errors
from cow_service.narration.summary import narrate
from cow_service.readers.options import choices_source, read_choices
from cow_service.records import SIMULATION_STAGES, STAGES, Answer, Problem, Simulation, Stage, Verdict, reading_of
from cow_service.requests import AnswerRequest, SimulateRequest
from cow_service.stages.answering import answer_question, ask_baseline, ask_first, gate_of
from cow_service.stages.depth import estimate_depth
from cow_service.stages.generation import generate
from cow_service.stages.grounding import ground
from cow_service.stages.motion import settle_motion
from cow_service.stages.run import Run
from cow_service.stages.trajectory import compute_trajectory


def simulate(run: Run[SimulateRequest]) -> Simulation:
    """Imagines the future of an image.

    Raises the errors of its stages: `InvalidRequest`, `CannotGround`, `CannotReadDirection`, `GeneratorUnavailable`,
    `Canceled`...
    """
    run.check_request()
    grounding = run.stage("grounding", ground)
    depth = run.stage("depth", estimate_depth) if run.wants_depth else None
    motion = run.stage("motion", settle_motion, grounding, run.read_motion, depth)
    trajectory = run.stage("trajectory", compute_trajectory, grounding, motion, depth)
    clip = run.stage("generation", generate, grounding, motion, trajectory)
    return Simulation(
        id=run.simulation_id,
        created_at=run.created_at,
        question=run.request.question,
        image=run.image.info,
        grounding=grounding,
        motion=motion,
        reading=reading_of(grounding, motion),
        trajectory=trajectory,
        narration=narrate(grounding, trajectory, run.language),
        **dict(clip),
        reader=run.reader_info(*SIMULATION_STAGES),
        **run.accounts(*SIMULATION_STAGES),
        warnings=run.warnings(*SIMULATION_STAGES),
    )


def answer(run: Run[AnswerRequest]) -> Answer:
    """Imagines, unless the request says never or the gate sees no need, then answers.

    A simulation that fails does not lose the answer: it is then given from the image alone, with a warning.
    Raises `InvalidRequest`, `Canceled`, `ReaderUnavailable`, `MllmBadReply`, `MllmRefused`, `MllmUnavailable`.
    """
    request = run.request
    first = run.stage("gating", ask_first) if request.imagine == "auto" else None
    gate = None if first is None else gate_of(first, request.imagine_threshold)
    wanted = request.imagine == "always" if gate is None else gate.imagined
    alone = None if first is None else first.verdict
    simulation, failure, verdict, alone = _look(run, alone) if wanted else (None, None, None, alone)
    if verdict is not None:  # whoever reads only the answer must see what it rests on
        missing: tuple[Stage, ...] = ("baseline",) if alone is None else ()
        warnings = run.warnings(*SIMULATION_STAGES, *missing, "answering")
    elif alone is not None:  # asked once is enough
        verdict, warnings = alone, run.warnings("baseline" if "baseline" in run.results else "gating")
    else:
        verdict = alone = run.stage("answering", answer_question, run.grounding, None)
        warnings = run.warnings("answering")
    if failure is not None:
        why = f"{failure.code}: {failure}"
        warnings = (f"Nothing was imagined, the answer is from the image alone. {why}", *warnings)
    return Answer(
        **dict(verdict),
        id=run.id,
        created_at=run.created_at,
        question=run.request.question,
        options=read_choices(run.request.question, run.request.options),
        options_source=choices_source(run.request.question, run.request.options),
        image=run.image.info,
        simulation=simulation,
        simulation_problem=None if failure is None else Problem(**failure.as_problem()),
        gate=gate,
        baseline=alone if request.baseline else None,
        reader=run.reader_info(*STAGES),
        **run.accounts(*STAGES),
        warnings=tuple(dict.fromkeys(warnings)),
    )


def _look(
    run: Run[AnswerRequest], alone: Verdict | None
) -> tuple[Simulation | None, errors.CowError | None, Verdict | None, Verdict | None]:
    """The simulation, or the error for which there is none; the answer after looking at it, and the one from the image
    alone, which is asked for meanwhile where the request wants it and it is not known.
    """
    is_asked = run.request.baseline and alone is None
    run.check_request()
    with run.beside("baseline", ask_baseline) if is_asked else nullcontext() as baseline:
        simulation, failure = _imagine(run)
        verdict = None if simulation is None else run.stage("answering", answer_question, run.grounding, simulation)
        return simulation, failure, verdict, alone if baseline is None else baseline().verdict


def _imagine(run: Run[AnswerRequest]) -> tuple[Simulation | None, errors.CowError | None]:
    """The simulation, or the error for which there is none. Raises what is no fault of the question."""
    try:
        return simulate(run), None
    except (errors.InvalidRequest, errors.Canceled, errors.MllmRefused):
        raise
    except errors.CowError as error:
        if error.status >= 500 and not isinstance(error, errors.MllmBadReply):
            raise  # the server could not imagine: that is no answer, and another try or process may do it
        return None, error
