"""Makes the picture of the README from an example: `make pictures`.

The example is asked twice: as its question has it, and with the arrow turned away. What is shown is what the service
computes: the paths of other futures, the frames, and in how many of the worlds it happens.
"""

import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from cow_service.media.images import decode_own
from cow_service.records import Simulation
from cow_service.requests import SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings

EXAMPLE = Path(__file__).parents[1] / "examples" / "ball-and-mug" / "image.jpg"
HERO = Path(__file__).parent / "hero.webp"
ASKED = "If the yellow ball rolls this way, will it hit the blue mug?"
FIRST, TURN, ARROW = (0.983, 0.182), math.radians(-52), 105  # direction of the arrow; how far it is turned; px
WIDTH, BAR, MS = 640, 58, 80  # px, px, ms of a frame
INK, DIM, YES, NO, ORANGE = "#18211f", "#5b6663", "#0f7b4f", "#b3261e", "#e4572e"


def simulated(service: Service, direction: tuple[float, float]) -> tuple[Simulation, list[Image.Image]]:
    """What happens when it sets out that way, and every second frame of that."""
    request = SimulateRequest.model_validate({
        "image": {"artifact": service.keep_image(EXAMPLE.read_bytes()).sha256},
        "question": "If the yellow ball moves, will it hit the blue mug?",
        "motion": {"direction": direction},
        "frames": {"indices": list(range(0, 49, 2)), "max_side": WIDTH},
        "video": False,
    })  # fmt: skip
    found = service.simulate(request)
    return found, [Image.fromarray(decode_own(service.artifacts.read(frame.sha256))) for frame in found.frames]


def drawn(
    picture: Image.Image,
    text: str,
    colour: str,
    arrow: tuple[Any, float] | None = None,
    futures: tuple[Simulation, float] | None = None,
    hand: bool = False,
) -> Image.Image:
    """A picture of the film: a frame with an arrow (start, angle) and futures (of a simulation, how visible)."""
    layer = Image.new("RGBA", picture.size, (0, 0, 0, 0))
    pen = ImageDraw.Draw(layer)
    if futures is not None:
        found, share = futures
        scale, path = picture.width / found.image.width, found.trajectory.path
        for way in path.futures:
            points = [(x * scale, y * scale) for x, y in way]
            pen.line(points, fill=(255, 255, 255, round(170 * share)), width=2, joint="curve")
        points = [(x * scale, y * scale) for x, y in path.points]
        pen.line(points, fill=(228, 87, 46, round(255 * share)), width=4, joint="curve")
    if arrow is not None:
        (x, y), angle = arrow
        tip = x + ARROW * math.cos(angle), y + ARROW * math.sin(angle)
        pen.line([(x, y), tip], fill=ORANGE, width=6)
        sides = [(tip[0] + 16 * math.cos(angle + side), tip[1] + 16 * math.sin(angle + side)) for side in (2.55, -2.55)]
        ahead = tip[0] + 10 * math.cos(angle), tip[1] + 10 * math.sin(angle)
        pen.polygon([ahead, *sides], fill=ORANGE)
        if hand:
            pen.ellipse([tip[0] - 13, tip[1] - 13, tip[0] + 13, tip[1] + 13], outline="white", width=3)
    whole = Image.new("RGB", (picture.width, picture.height + BAR), "white")
    whole.paste(Image.alpha_composite(picture.convert("RGBA"), layer), (0, 0))
    pen = ImageDraw.Draw(whole)
    pen.text((16, picture.height + BAR / 2), text, fill=colour, font=ImageFont.load_default(21), anchor="lm")
    return whole


def film(service: Service) -> list[Image.Image]:
    """The question, its futures and its answer; then the same with the arrow turned away."""
    shown: list[Image.Image] = []
    angle = math.atan2(FIRST[1], FIRST[0])
    for place, to in enumerate((angle, angle + TURN)):
        found, frames = simulated(service, (math.cos(to), math.sin(to)))
        outcome, scale = found.trajectory.outcome, frames[0].width / found.image.width
        assert outcome is not None
        assert outcome.probability is not None
        start = tuple(scale * side for side in found.trajectory.path.points[0])
        if place:
            turns = np.linspace(angle, to, 14)
            shown += [drawn(frames[0], "And this way?", INK, (start, float(turn)), hand=True) for turn in turns]
        asked = "And this way?" if place else ASKED
        shown += [drawn(frames[0], asked, INK, (start, to))] * (6 if place else 16)
        shown += [drawn(frames[0], asked, DIM, (start, to), (found, share)) for share in np.linspace(0, 1, 8)]
        fade = np.linspace(1, 0, len(frames))
        shown += [drawn(each, asked, DIM, None, (found, share)) for each, share in zip(frames, fade, strict=True)]
        worlds = found.trajectory.ensemble
        hits = round(outcome.probability * worlds)
        word, colour = ("Yes", YES) if outcome.probability >= 0.5 else ("No", NO)
        shown += [drawn(frames[-1], f"{word}: it hits the mug in {hits} of {worlds} simulated versions.", colour)] * 20
    return shown


def main() -> None:
    """Writes the film."""
    with tempfile.TemporaryDirectory() as folder, Service(Settings(data_dir=Path(folder))) as service:
        first, *others = film(service)
    first.save(HERO, save_all=True, append_images=others, duration=MS, loop=0, quality=72, method=6)
    print(f"{HERO.name}: {HERO.stat().st_size / 1e6:.2f} MB, {len(others) + 1} frames")


if __name__ == "__main__":
    main()
