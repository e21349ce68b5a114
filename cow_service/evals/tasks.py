"""The tasks, solver and scorer for Inspect: `inspect eval cow_service/causalspatial -T data=FOLDER -T arm=always`."""

from __future__ import annotations

import atexit
import secrets
from collections.abc import Generator, Sequence
from contextlib import ExitStack, contextmanager

from inspect_ai import Epochs, Task, task
from inspect_ai.dataset import MemoryDataset, Sample
from inspect_ai.model import GenerateConfig, ModelOutput, get_model
from inspect_ai.scorer import Score, Scorer, Target, mean, scorer, std
from inspect_ai.solver import Generate, Solver, TaskState, solver

from cow_service.evals.arms import Arm, check_arms
from cow_service.evals.asking import Asking, Case, observed
from cow_service.evals.by_answer import ByAnswer
from cow_service.evals.by_prompt import ByPrompt
from cow_service.evals.conversation import conversation
from cow_service.evals.items import Item, question_text
from cow_service.evals.loaders import CAUSALSPATIAL, load
from cow_service.evals.observations import Ask, Observation
from cow_service.evals.plan import MAX_TOKENS, request_options
from cow_service.evals.progress import count
from cow_service.evals.replies import order_of
from cow_service.evals.session import Session, active_session, own_folder, session
from cow_service.readers.prompts import load_prompt

ITEM, OBSERVATION = "item", "observation"  # where a sample holds them


@task
def causalspatial(
    data: str = CAUSALSPATIAL,
    arm: str = "always",
    subsets: str | list[str] = "",
    ask: Ask = "prompt",
    repeats: int = 1,
    seed: int = 0,
    limit: int | None = None,
    reader: str | None = None,
    generator: str | None = None,
    url: str | None = None,
) -> Task:
    """What-if questions on images, in one arm: data sets in any form that `load` reads.

    `subsets` are separated by commas. Without `url` a server runs in the process. Raises `InvalidRequest`.
    """
    items = _prepared[-1] if _prepared else _loaded(data, subsets, limit, url, reader, generator)
    (one,) = check_arms([arm], ask, items)
    return arm_task(items, one, ask, repeats, seed)


_prepared: list[Sequence[Item]] = []


@contextmanager
def prepared(items: Sequence[Item]) -> Generator[None]:
    """Tasks that are made meanwhile have these items, whatever `data` says: they were loaded and checked before."""
    _prepared.append(items)
    try:
        yield
    finally:
        _prepared.pop()


def _loaded(
    data: str, subsets: str | list[str], limit: int | None, url: str | None, reader: str | None, generator: str | None
) -> Sequence[Item]:
    """The items of a data set, with the session of the first task of the process."""
    shared = active_session()
    if shared is None:
        stack = ExitStack()
        atexit.register(stack.close)
        options = request_options(reader, generator)
        shared = stack.enter_context(session(own_folder(), url, options, *[secrets.token_hex(8)] * 2))
    named = subsets.split(",") if isinstance(subsets, str) else subsets
    return load(data, shared.pictures, subsets=[part.strip() for part in named if part.strip()]).items[:limit]


def arm_task(items: Sequence[Item], arm: Arm, ask: Ask, repeats: int, seed: int) -> Task:
    """The task that asks all items in one arm."""
    samples = [
        Sample(
            id=item.id,
            input=question_text(item),
            target=item.answer,
            choices=[option.text for option in item.options],
            metadata={ITEM: item.model_dump(mode="json")},
        )
        for item in items
    ]
    return Task(
        dataset=MemoryDataset(samples, name=arm.name),
        solver=look_and_ask(arm.name, ask, seed),
        scorer=chosen_option(),
        epochs=Epochs(repeats, "mean"),
        config=GenerateConfig(max_tokens=MAX_TOKENS),
        name=f"{arm.name}",
        version=load_prompt("eval-question").version,
    )


@solver
def look_and_ask(arm: str, ask: Ask, seed: int) -> Solver:
    """Asks one question in one arm, with its options in the order of the repeat."""

    async def solve(state: TaskState, generate: Generate) -> TaskState:
        item = Item.model_validate(state.metadata[ITEM])
        (one,) = check_arms([arm], ask, [item])
        case = Case(item, one, state.epoch, order_of(item, seed, state.epoch))
        try:
            asked = await _asking(ask)(case)
        except Exception:
            count(arm, None)
            raise
        seen = observed(case, asked)
        count(arm, seen)
        state.store.set(OBSERVATION, seen.model_dump(mode="json"))
        state.messages = conversation(case, asked, seen.overlay, _shared().pictures)
        state.output = ModelOutput.from_content(str(state.model), asked.replies[-1].text)
        state.completed = True
        return state

    return solve


def _shared() -> Session:
    shared = active_session()
    if shared is None:
        raise RuntimeError("The solver runs in tasks of `causalspatial` alone.")
    return shared


def _asking(ask: Ask) -> Asking:
    shared = _shared()
    if ask == "answer":
        return ByAnswer(shared.client(), shared.pictures, shared.options, shared.key)
    return ByPrompt(get_model(), shared.imagination(), shared.pictures, shared.reply_key)


@scorer(metrics={"right": [mean(), std()], "abstained": [mean()], "unreadable": [mean()]})
def chosen_option() -> Scorer:
    """Whether the reply chooses the right option, abstains, or cannot be read."""

    async def score(state: TaskState, target: Target) -> Score:
        seen = Observation.model_validate(state.store.get(OBSERVATION))
        return Score(
            value={"right": int(seen.right), "abstained": int(seen.abstained), "unreadable": int(seen.unreadable)},
            answer=seen.read,
            explanation=seen.reply,
            metadata={OBSERVATION: seen.model_dump(mode="json")},
        )

    return score
