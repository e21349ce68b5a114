"""Makes the pictures of the README and of these pages from the examples: `make pictures`.

Everything shown is computed by the service: the paths of other futures, the frames, and in how many of the worlds it
happens. The page is a screenshot, for which chromium must be installed; without it that picture stays as it is.
"""

import io
import math
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from playwright.sync_api import sync_playwright

from cow_service.media.images import decode_own
from cow_service.records import Simulation
from cow_service.requests import SimulateRequest
from cow_service.server import serving
from cow_service.service import Service
from cow_service.settings import Settings

DOCS = Path(__file__).parent
EXAMPLES = DOCS.parent / "examples"
EXAMPLE = EXAMPLES / "ball-and-mug" / "image.jpg"
HERO = DOCS / "hero.webp"
ASKED = "If the yellow ball rolls this way, will it hit the blue mug?"
QUESTION = "If the yellow ball moves opposite to the direction of the arrow, will it hit the blue mug?"
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
        told = found.narration
        colour = YES if outcome.probability >= 0.5 else NO
        shown += [drawn(frames[-1], f"{told.answer}. {told.agreement}", colour)] * 20
    return shown


def asked(service: Service, example: str, question: str, **fields: Any) -> Simulation:
    """A simulation of an example, with pictures of its events."""
    image = service.keep_image((EXAMPLES / example / "image.jpg").read_bytes()).sha256
    body = {"image": {"artifact": image}, "question": question, "frames": {"max_side": WIDTH}, "video": False} | fields
    return service.simulate(SimulateRequest.model_validate(body))


def opened(service: Service, sha256: str) -> Image.Image:
    """A kept picture."""
    return Image.fromarray(decode_own(service.artifacts.read(sha256)))


def in_row(panels: list[tuple[Image.Image, str]], width: int, gap: int = 10) -> Image.Image:
    """Pictures side by side, each with a line below it."""
    small = [each.convert("RGB").resize((width, round(each.height * width / each.width))) for each, _ in panels]
    row = Image.new("RGB", (len(small) * (width + gap) - gap, small[0].height + 30), "white")
    pen = ImageDraw.Draw(row)
    for place, (each, (_, line)) in enumerate(zip(small, panels, strict=True)):
        row.paste(each, (place * (width + gap), 0))
        pen.text((place * (width + gap) + 2, each.height + 8), line, fill=INK, font=ImageFont.load_default(16))
    return row


def verdict(found: Simulation) -> str:
    """The answer of a simulation, and how many versions agree."""
    return f"{found.narration.answer}. {found.narration.agreement}"


def ask_picture(service: Service) -> Image.Image:
    """A question from the picture to the frames."""
    found = asked(
        service, "falling-ball", "If the black ball falls freely, will it land on the orange cylinder?", num_frames=17
    )
    frames = [(opened(service, each.sha256), f"{each.time:.2f} s") for each in found.frames[1:3]]
    return in_row(
        [
            (Image.open(EXAMPLES / "falling-ball" / "image.jpg"), "your picture"),
            (opened(service, found.overlay.sha256), "what COW reads and computes"),
            *frames,
        ],
        320,
    )


def correct_picture(service: Service) -> Image.Image:
    """A motion as it is read, and what two corrections change."""
    read = asked(service, "ball-and-mug", QUESTION)
    turned = asked(service, "ball-and-mug", QUESTION, motion={"direction": [1, -0.8]})
    stopped = asked(service, "ball-and-mug", QUESTION, motion={"distance": 100})
    return in_row(
        [
            (opened(service, found.overlay.sha256), f"{what}: {verdict(found)}")
            for found, what in ((read, "as read"), (turned, "other direction"), (stopped, "100 px far"))
        ],
        430,
    )


def world_picture(service: Service) -> Image.Image:
    """The futures of a throw."""
    found = asked(
        service,
        "thrown-ball",
        "If the pink ball is thrown in the direction of the arrow, will it hit the white cube?",
        frames={"max_side": WIDTH, "indices": [0, 14]},
    )
    clean = drawn(opened(service, found.frames[0].sha256), "", INK, futures=(found, 1.0))
    clean = clean.crop((0, 0, clean.width, clean.height - BAR))
    end = opened(service, found.frames[-1].sha256)
    return in_row([(clean, "likeliest path, and eight others"), (end, f"it hits the cube: {verdict(found)}")], 480)


def photograph_picture(service: Service) -> Image.Image:
    """A photograph with boxes from the request: what is cut out, and where it goes."""
    image = service.keep_image((EXAMPLES / "photographs" / "coffee.jpg").read_bytes()).sha256
    body = {
        "image": {"artifact": image},
        "question": "If the cup slides to the left, will it fall off the saucer?",
        "grounding": {"object": "cup", "bbox": [172, 18, 405, 300]},
        "objects": [{"object": "saucer", "bbox": [77, 66, 480, 388]}],
        "frames": {"max_side": WIDTH, "indices": [16]},
        "video": False,
    }
    found = service.simulate(SimulateRequest.model_validate(body))
    frame = opened(service, found.frames[0].sha256)
    return in_row([(opened(service, found.overlay.sha256), "what COW cuts out"), (frame, verdict(found))], 430)


def page_picture(service: Service) -> Image.Image | None:
    """The page with an answer, as chromium shows it."""
    program = shutil.which("chromium")
    if program is None:
        return None
    with serving(service) as address, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 840}, reduced_motion="reduce")
        page.goto(address)
        page.locator("input[type=file]").first.set_input_files(EXAMPLE)
        page.locator("#question").fill(QUESTION)
        page.locator("#question").press("Enter")
        page.locator(".result[data-job]:not(.old)").wait_for(timeout=60_000)
        page.wait_for_timeout(3_000)  # until the film and its frames are there
        shot = page.screenshot()
        browser.close()
    return Image.open(io.BytesIO(shot)).resize((1000, 656))


def main() -> None:
    """Writes them."""
    with tempfile.TemporaryDirectory() as folder, Service(Settings(data_dir=Path(folder), port=0)) as service:
        first, *others = film(service)
        pictures = {"ask": ask_picture(service), "correct": correct_picture(service), "world": world_picture(service)}
        pictures["photographs"] = photograph_picture(service)
        pictures |= {"page": shown} if (shown := page_picture(service)) else {}
    first.save(HERO, save_all=True, append_images=others, duration=MS, loop=0, quality=72, method=6)
    print(f"{HERO.name}: {HERO.stat().st_size / 1e6:.2f} MB, {len(others) + 1} frames")
    for name, picture in pictures.items():
        file = DOCS / f"{name}.webp"
        picture.save(file, quality=80, method=6)
        print(f"{file.name}: {file.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
