"""The gallery of the site: scenes with known answers, each computed when mkdocs builds the pages.

Where a direction can be dragged, a scene is the page that a result is passed on as (`media.share`), without the engine:
that is one script for all of them, which works from file://, too. The others are films.
"""

import html
import json
import os
import re
import tempfile
from functools import cache
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from cow_service.media.images import encode_jpeg, fit_within
from cow_service.media.share import Told, still
from cow_service.media.share import page as page_of
from cow_service.media.video import Pixels, frames_of, write_mp4
from cow_service.records import Simulation
from cow_service.requests import AnswerRequest
from cow_service.service import Service
from cow_service.settings import Settings

ROOT = Path(__file__).resolve().parents[2]
MARK = "<!-- gallery -->"
BULLET, MUJOCO = "cow-scenes/sample/truth", "cow-scenes/sample_other/truth"
BOXED = "+"  # after a folder: the request has the objects' boxes and the direction, as one corrects them on the page
SCENES = {
    "It rolls or slides": (
        "examples/ball-and-mug",
        f"{MUJOCO}/collision/Collision_Level_1_0+",
        f"{BULLET}/collision/Collision_Level_1_0",
        "examples/car-forward",
        f"{MUJOCO}/collision/Collision_Level_1_1+",
        f"{MUJOCO}/physics/Physics_Level_2_0+",
    ),
    "It flies or falls": ("examples/thrown-ball", f"{BULLET}/physics/Physics_Level_1_0", "examples/falling-ball"),
    "One hits the next": (f"{BULLET}/physics/Physics_Level_2_0", f"{BULLET}/collision/Collision_Level_2_0"),
    "It hides something": (
        "examples/bottle-passes-cylinder",
        f"{BULLET}/occlusion/Occlusion_Level_1_0",
        f"{BULLET}/occlusion/Occlusion_Level_1_1",
        f"{BULLET}/occlusion/Occlusion_Level_2_0",
        f"{MUJOCO}/occlusion/Occlusion_Level_1_0+",
    ),
    "Something is taken away first": (
        f"{BULLET}/collision/Collision_Level_1_1",
        f"{MUJOCO}/collision/Collision_Level_2_0+",
    ),
    "It is put somewhere": (
        f"{BULLET}/compatibility/Compatibility_Level_1_1",
        f"{BULLET}/compatibility/Compatibility_Level_2_0+",
    ),
}
MOST = int(os.environ.get("COW_GALLERY", "6"))  # of each kind, at most: tests do with fewer
SIDE, REST = 640, 0.8  # px, of a film; s that it goes on once nothing moves
PART = re.compile(r'<script type="text/plain" id="(?!world")[^"]+">.*?</script>\n', re.DOTALL)
# Brings the parts of the page into a scene's document, before its own script looks for them.
ENGINE = """if (parent !== window) document.documentElement.classList.add("framed");
document.body.insertAdjacentHTML("beforeend", """
POLICY = "img-src data:", "script-src 'unsafe-inline'"
FRAMED = """<style>.framed h1, .framed small { display: none }
.framed main { padding: 0 }
.framed #told { margin: .5rem .7rem; font-size: .9rem; line-height: 1.2; flex-wrap: nowrap; min-block-size: 1.6rem }
.framed meter { inline-size: 4rem; flex: none }
.framed circle.tip { stroke: #fff; stroke-width: 4px }</style>
</head>"""


@cache
def built() -> tuple[str, dict[str, bytes]]:
    """The Markdown of the gallery, and its files by name. Raises `ValueError` where one is not sure and right."""
    text, files = "", {}
    with tempfile.TemporaryDirectory() as data, Service(Settings(data_dir=Path(data), reader="embedded")) as service:
        for kind, (title, places) in enumerate(SCENES.items(), start=1):
            cards = (card(service, place, f"{kind}-{n}", files) for n, place in enumerate(places[:MOST], start=1))
            text += f'## {title}\n\n<div class="scenes">\n{"".join(cards)}</div>\n\n'
    return text, files


def asked(service: Service, place: str) -> tuple[bytes, Simulation, Told, str]:
    """A scene's picture, its simulation, what it says, and what was given besides picture and question."""
    folder = ROOT / place.removesuffix(BOXED)
    picture, meta = (folder / "image.jpg").read_bytes(), json.loads((folder / "meta.json").read_text())
    image, question, given = {"artifact": service.keep_image(picture).sha256}, meta["question"], ""
    request = {"image": image, "question": question, "live": True, "video": True}
    if place.endswith(BOXED):
        (width, height), given = meta["image_size"], "COW was given the boxes of the objects."
        starts = {name: boxes[0] for name, boxes in meta["boxes"].items()}
        boxes = {n: [max(0, x0), max(0, y0), min(width, x1), min(height, y1)] for n, (x0, y0, x1, y1) in starts.items()}
        request["grounding"] = {"object": meta["object"], "bbox": boxes.pop(meta["object"])}
        request["objects"] = [{"object": name, "bbox": box} for name, box in boxes.items()]
        if meta["motion"] != "fall":
            request["motion"], given = (
                {"direction": meta["direction"]},
                given.replace("objects", "objects and the direction"),
            )
    answer = service.answer(AnswerRequest.model_validate(request))
    simulation = answer.simulation
    outcome = None if simulation is None else simulation.trajectory.outcome
    if simulation is None or outcome is None or not outcome.sure or answer.answer != meta["answer"]:
        raise ValueError(f"{place}: {answer.option!r} is not the sure and right answer {meta['answer']}.")
    short = answer.model_copy(update={"question": question.partition(" Answer by ")[0]})
    return picture, simulation, Told.of(short, simulation, ""), given


def card(service: Service, place: str, name: str, files: dict[str, bytes]) -> str:
    """The HTML of one scene; adds its files."""
    picture, simulation, told, given = asked(service, place)
    files[f"{name}.jpg"] = picture
    assert simulation.video is not None
    frames, fps = frames_of(service.artifacts.read(simulation.video.sha256))
    live, address = simulation.trajectory.live, ""
    if live is None:
        files[f"{name}.mp4"] = film(frames, fps, simulation.trajectory.moving_until)
        shown = f'<video src="gallery/{name}.mp4" poster="gallery/{name}.jpg" muted loop playsinline controls></video>'
    else:
        address, first = f"gallery/{name}.html", f"{name}.jpg"
        if simulation.grounding.interventions:  # what is taken away is in the picture, but not in the clip
            first = f"{name}-first.jpg"
            files[first] = encode_jpeg(frames[0])
        whole = page_of(still(picture), service.artifacts.read(live.sha256).decode(), simulation, told).decode()
        files["engine.js"] = (ENGINE + json.dumps("".join(PART.findall(whole))) + ");\n").encode()
        files[f"{name}.html"] = in_frame(PART.sub("", whole), first).encode()
        shown, given = (
            f'<img src="gallery/{name}.jpg" alt="" loading="lazy">',
            f'{given} <a href="{address}" target="_blank">Larger (a new tab)</a>',
        )
    size = f"--width: {simulation.image.width}; --height: {simulation.image.height}"
    said = f"<b>{html.escape(told.question)}</b> As asked: {html.escape(told.verdict)}. {given}"
    return (
        f'<figure class="scene" data-world="{address}" style="{size}">\n<div>{shown}</div>\n'
        f"<figcaption>{said}</figcaption>\n</figure>\n"
    )


def film(frames: list[Pixels], fps: float, until: float | None) -> bytes:
    """A small mp4 of a clip, which ends soon after nothing moves any more."""
    shown = [fit_within(frame, SIDE) for frame in frames[: round(((until or len(frames) / fps) + REST) * fps)]]
    height, width = shown[0].shape[:2]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "film.mp4"
        write_mp4(shown, out, fps=fps, width=width, height=height)
        return out.read_bytes()


def in_frame(text: str, picture: str) -> str:
    """The page of a scene, with the engine and its picture from files beside it."""
    text = re.sub(r'src="data:image/jpeg[^"]+"', f'src="{picture}"', text, count=1)
    for rule in POLICY:
        text = text.replace(rule, f"{rule} 'self' file:")
    text = text.replace("</head>", FRAMED)
    return text.replace('<script type="module">', '<script src="engine.js"></script>\n<script type="module">')


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds what the scenes consist of."""
    for name, content in built()[1].items():
        files.append(File.generated(config, f"gallery/{name}", content=content))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Puts the scenes into their page."""
    return markdown.replace(MARK, built()[0]) if page.file.src_uri == "gallery.md" else markdown
