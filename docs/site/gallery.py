"""The gallery of the site: scenes with known answers, each computed when mkdocs builds the pages.

Where a direction can be dragged, a scene is the page that a result is passed on as (`media.share`), without the engine:
that is one script for all of them, which works from file://, too. The others are films.
"""

import html
import json
import re
import tempfile
from functools import cache
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from cow_service.media.images import decode_own
from cow_service.media.share import Told
from cow_service.media.share import page as page_of
from cow_service.media.video import frames_of, write_mp4
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
SIDE, REST = 640, 0.8  # px, of a film; s that it goes on once nothing moves
PART = re.compile(r'<script type="text/plain" id="(?!world")[^"]+">.*?</script>\n', re.DOTALL)
POLICY = "img-src data:", "script-src 'unsafe-inline'"
FRAMED = """<style>.framed h1, .framed small { display: none }
.framed main { padding: 0 }
.framed #told { margin: .7rem; font-size: 1rem; flex-wrap: nowrap; white-space: nowrap }
.framed meter { inline-size: 5rem }</style>
</head>"""


@cache
def built() -> tuple[str, dict[str, bytes]]:
    """The Markdown of the gallery, and its files by name. Raises `ValueError` where one is not sure and right."""
    text, files = "", {}
    with tempfile.TemporaryDirectory() as data, Service(Settings(data_dir=Path(data), reader="embedded")) as service:
        for title, folders in SCENES.items():
            cards = "".join(card(service, folder, files) for folder in folders)
            text += f'## {title}\n\n<div class="scenes">\n{cards}</div>\n\n'
    return text, files


def card(service: Service, place: str, files: dict[str, bytes]) -> str:
    """The HTML of one scene; adds its files."""
    folder = ROOT / place.removesuffix(BOXED)
    picture, meta = (folder / "image.jpg").read_bytes(), json.loads((folder / "meta.json").read_text())
    image = {"artifact": service.keep_image(picture).sha256}
    request = {"image": image, "question": meta["question"], "live": True, "video": True}
    if place.endswith(BOXED):
        width, height = meta["image_size"]
        boxes = {name: clipped(box[0], width, height) for name, box in meta["boxes"].items()}
        request["grounding"] = {"object": meta["object"], "bbox": boxes.pop(meta["object"])}
        request["objects"] = [{"object": name, "bbox": box} for name, box in boxes.items()]
        if meta["motion"] != "fall":
            request["motion"] = {"direction": meta["direction"]}
    answer = service.answer(AnswerRequest.model_validate(request))
    simulation = answer.simulation
    outcome = None if simulation is None else simulation.trajectory.outcome
    if simulation is None or outcome is None or not outcome.sure or answer.answer != meta["answer"]:
        raise ValueError(f"{place}: {answer.option!r} is not the sure and right answer {meta['answer']}.")
    told = Told.of(answer.model_copy(update={"question": meta["question"].partition(" Answer by ")[0]}), simulation, "")
    name = f"{sum(each.endswith('.jpg') for each in files) + 1:02}"
    files[f"{name}.jpg"] = picture
    live, size = simulation.trajectory.live, (simulation.image.width, simulation.image.height)
    if live is None:
        files[f"{name}.mp4"] = film(service, simulation)
        shown = f'<video src="gallery/{name}.mp4" poster="gallery/{name}.jpg" muted loop playsinline controls></video>'
    else:
        whole = page_of(decode_own(picture), service.artifacts.read(live.sha256).decode(), simulation, told).decode()
        files["engine.js"] = (ENGINE + json.dumps("".join(PART.findall(whole))) + ");\n").encode()
        files[f"{name}.html"] = in_frame(PART.sub("", whole), f"{name}.jpg").encode()
        shown = f'<img src="gallery/{name}.jpg" alt="" loading="lazy">'
    boxed = " The boxes of its objects were given." if place.endswith(BOXED) else ""
    link = "" if live is None else f' <a href="gallery/{name}.html">Larger</a>'
    return (
        f'<figure class="scene" data-world="{"" if live is None else f"gallery/{name}.html"}" '
        f'style="--width: {size[0]}; --height: {size[1]}">\n<div>{shown}</div>\n'
        f"<figcaption><b>{html.escape(told.question)}</b> {html.escape(told.verdict)}.{boxed}{link}</figcaption>\n"
        "</figure>\n"
    )


# Brings the parts of the page into a scene's document, before its own script looks for them.
ENGINE = """if (parent !== window) document.documentElement.classList.add("framed");
document.body.insertAdjacentHTML("beforeend", """


def clipped(box: list[float], width: int, height: int) -> list[float]:
    """The part of a box that is in the image."""
    x0, y0, x1, y1 = box
    return [max(0, x0), max(0, y0), min(width, x1), min(height, y1)]


def film(service: Service, simulation: Simulation) -> bytes:
    """The clip until nothing moves, as a small mp4."""
    assert simulation.video is not None
    frames, fps = frames_of(service.artifacts.read(simulation.video.sha256), SIDE)
    until = simulation.trajectory.moving_until or len(frames) / fps
    height, width = frames[0].shape[:2]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "film.mp4"
        write_mp4(frames[: round((until + REST) * fps)], out, fps=fps, width=width, height=height)
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
