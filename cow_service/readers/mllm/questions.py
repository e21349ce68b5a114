"""The questions of one look: each prompt with its inputs, its images, its schema and how its reply is read."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

from cow_service.readers.base import AnswerReading, Asked, Imagined
from cow_service.readers.mllm import choose, identify, locate, scale
from cow_service.readers.mllm.asking import Question
from cow_service.readers.mllm.coordinates import View
from cow_service.readers.mllm.identify import Identified
from cow_service.readers.mllm.locate import Located
from cow_service.readers.mllm.pictures import encode, view_of
from cow_service.readers.mllm.scale import Scaled
from cow_service.readers.mllm.serving import Served
from cow_service.readers.mllm.units import box_order, line_order, units_of
from cow_service.readers.question.choices import question_without
from cow_service.records import MEETINGS, AnswerOption, BBox, Encounter
from cow_service.vision.scene import Scene

REASONING = 2000  # characters, where the manifest says nothing else
VOTING_TEMPERATURE = 0.7  # without chance every vote would be the same


class Questions:
    """What can be asked about one image and one question of a caller. It asks nothing."""

    def __init__(self, served: Served, scene: Scene, asked: Asked) -> None:
        self._served = served
        self._scene = scene
        self._asked = asked
        self._reasoning = int(served.manifest.defaults.get("max_reasoning", REASONING))

    @cached_property
    def view(self) -> View:
        """How the model sees the image."""
        return view_of(self._scene.image, self._served.family)

    @cached_property
    def _image(self) -> bytes:
        return encode(self._scene.image, self.view.seen)

    def identify(self) -> Question[Identified | None]:
        """Which object moves, in words, and how."""
        return Question(
            prompt="identify",
            inputs={"question": self._asked.question},
            images=(self._image,),
            schema=identify.schema(self._reasoning),
            read=identify.read_identified,
            seed=self._asked.seed,
        )

    def locate(
        self, name: str, bbox: BBox | None, others: Sequence[str], wants_direction: bool
    ) -> Question[Located | None]:
        """Where that object is, unless its box is known, and which way it moves."""
        view, wants_box = self.view, bbox is None
        known = "" if bbox is None else str(view.write((bbox[0], bbox[1]), (bbox[2], bbox[3])))
        return Question(
            prompt="locate",
            inputs={
                "question": self._asked.question,
                "object": " ".join(name.split()),
                "others": tuple(others),
                "bbox": known,
                "units": units_of(view),
                "box_key": view.coordinates.box,
                "box_order": box_order(view),
                "line_order": line_order(view),
                "wants_box": wants_box,
                "wants_direction": wants_direction,
            },
            images=(self._image,),
            schema=locate.schema(view, bool(others), wants_box, wants_direction, self._reasoning),
            read=lambda reply: locate.read_located(reply, view, name, others, wants_box, wants_direction),
            seed=self._asked.seed,
        )

    def scale(self, name: str) -> Question[Scaled]:
        """How large the scene is at that object, and which way is down."""
        view = self.view
        return Question(
            prompt="scale",
            inputs={
                "object": " ".join(name.split()),
                "units": units_of(view),
                "line_order": line_order(view),
            },
            images=(self._image,),
            schema=scale.schema(view, self._reasoning),
            read=lambda reply: scale.read_scaled(reply, view),
            seed=self._asked.seed,
        )

    def answers(
        self, options: Sequence[AnswerOption], imagined: Imagined | None, votes: int
    ) -> list[Question[AnswerReading]]:
        """The answer, asked for `votes` times: the image first, then the frames, and what they would meet as text."""
        asked = question_without(self._asked.question, options)
        question: dict[str, object] = {"question": asked, "options": tuple(options)}
        frames = () if imagined is None else imagined.frames
        pictures = (self._image, *(encode(f, view_of(f, self._served.family).seen) for f in frames))
        return [
            Question(
                prompt="answer-from-image" if imagined is None else "answer-with-frames",
                inputs=question if imagined is None else question | _hypothesis(imagined),
                images=pictures,
                schema=choose.schema(options, self._reasoning),
                read=lambda reply: choose.read_answer(reply, options),
                seed=(self._asked.seed + vote) % 2**31,
                temperature=VOTING_TEMPERATURE if votes > 1 else None,
            )
            for vote in range(votes)
        ]


def _hypothesis(imagined: Imagined) -> dict[str, object]:
    """What the simulation found, in words."""
    simulation = imagined.simulation
    times = ", ".join(f"{frame.time:.2f} s" for frame in simulation.frames)
    met = tuple(_met(encounter, simulation.trajectory.fps) for encounter in simulation.trajectory.encounters)
    known = simulation.encounters_known
    return {"sentence": simulation.motion.sentence, "times": times, "encounters": met, "encounters_known": known}


def _met(encounter: Encounter, fps: float) -> str:
    name = " ".join(encounter.object.split())
    return f"{MEETINGS[encounter.kind]} the {name.removeprefix('the ')}, {encounter.first_frame / fps:.2f} s in"
