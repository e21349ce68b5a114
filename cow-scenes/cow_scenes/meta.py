"""`meta.json`: the truth of an item in plain numbers; no picture is read or drawn here."""

import numpy as np

from .accept import Accepted, still, trail_of
from .arrows import Arrow
from .camera import Camera
from .maps import DEPTH_SCALE, id_numbers
from .plan import ItemKey
from .raster import placed
from .world import FPS, SAMPLES, Run, Thing

FUTURE = (12, 36)


def letter(index: int) -> str:
    """A for 0, B for 1 and so on."""
    return chr(ord("A") + index)


def question_of(question: str, options: tuple[str, ...]) -> str:
    """The question with its options as the data set words them."""
    named = [f"({letter(i)}) {text}" for i, text in enumerate(options)]
    return f"{question} Answer by {', '.join(named[:-1])} or {named[-1]}."


def rounded(values: np.ndarray, digits: int) -> list:
    """Nested lists of floats."""
    return np.round(np.asarray(values, float), digits).tolist()


def box_of(camera: Camera, thing: Thing, centre: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Pixels (4,): left, top, right, bottom of the projected mesh, not cut at the border."""
    pixels = camera.project(placed(thing, centre, turn))
    return np.concatenate([pixels.min(0), pixels.max(0)])


def boxes_of(item: Accepted, thing: Thing) -> np.ndarray:
    """Boxes (61, 4) of an object."""
    centres, turns = item.run.centres[thing.name], item.run.turns[thing.name]
    later = [box_of(item.camera, thing, centres[s], turns[s]) for s in range(1, SAMPLES)]
    return np.stack([box_of(item.camera, thing, *still(thing)), *later])


def direction_of(item: Accepted) -> np.ndarray:
    """Unit direction (2,) in pixels in which the mover sets out; down for a fall, to the bowl for a placing."""
    mover, world = item.draft.world.thing(item.draft.world.mover), item.draft.world
    start = np.array(mover.centre)
    if world.carry_to is not None:
        end = np.array(world.thing(item.draft.target).centre)
    elif item.draft.motion == "fall":
        end = start - np.array([0, 0, 0.01])
    else:
        end = start + np.array(world.velocity) * 1e-3
    step = item.camera.project(end) - item.camera.project(start)
    return step / np.linalg.norm(step)


def hits_of(item: Accepted, run: Run) -> dict[str, int]:
    """First sample at which the mover touches each object."""
    mover, hits = item.draft.world.mover, {}
    names = {t.name for t in item.draft.world.things}
    for contact in run.contacts:
        if mover in {contact.a, contact.b}:
            other = contact.b if contact.a == mover else contact.a
            if other in names:
                hits.setdefault(other, contact.sample)
    return hits


def contacts_of(run: Run) -> list[dict]:
    """Every touch that began after t = 0, in the order of time."""
    return [
        {
            "a": c.a, "b": c.b, "time": round(c.time, 5), "point": rounded(np.array(c.point), 4),
            "impulse": round(c.impulse, 4), "first_sample": c.sample,
        }
        for c in run.contacts
    ]  # fmt: skip


def world_of(run: Run) -> dict[str, list]:
    """Centres (61, 3) in metres by object."""
    return {name: rounded(centres, 4) for name, centres in run.centres.items()}


def fit_of(item: Accepted) -> dict | None:
    """Metres for the form `place`: narrowest width to pass, the bowl's opening and its rim at the last sample."""
    if item.draft.world.carry_to is None:
        return None
    mover, bowl = item.draft.world.thing(item.draft.world.mover), item.draft.world.thing(item.draft.target)
    return {
        "width": round(mover.width, 4), "opening": round(bowl.opening, 4),
        "rim": round(float(item.run.centres[bowl.name][-1][2]) + bowl.height / 2, 4),
    }  # fmt: skip


def chain_of(item: Accepted) -> dict | None:
    """The ball in between and the sample at which it meets the target, or null there."""
    via = item.draft.via
    if via is None:
        return None
    contact = item.run.first(via, item.draft.target)
    return {"via": via, "hit": contact.sample if contact else None}


def naming(key: ItemKey, item: Accepted) -> dict:
    """Id, question and answer."""
    draft = item.draft
    return {
        "id": key.id, "task": key.task, "level": key.level, "image_size": [item.camera.width, item.camera.height],
        "question": question_of(draft.question, draft.options), "options": list(draft.options),
        "answer": letter(item.answer), "not_sure": letter(len(draft.options) - 1), "form": draft.form,
        "motion": draft.motion, "object": draft.world.mover, "target": draft.target,
    }  # fmt: skip


def camera_of(camera: Camera) -> dict:
    """The camera as matrices and in words; `depth_scale` is metres per unit of `depth.png`."""
    right, down, forward = camera.pose[:3, :3].T
    return {
        "K": rounded(camera.matrix, 6), "world_from_camera": rounded(camera.pose, 8),
        "focal": round(camera.focal, 6), "pitch": round(float(np.degrees(np.arcsin(-forward[2]))), 6),
        "roll": round(float(np.degrees(np.arctan2(-right[2], -down[2]))), 6) + 0.0,
        "height": round(float(camera.pose[2, 3]), 6), "depth_scale": DEPTH_SCALE,
    }  # fmt: skip


def geometry(item: Accepted) -> dict:
    """What is seen: pixels by sample, ids and the camera."""
    things, camera = item.draft.world.things, item.camera
    mover = item.draft.world.thing(item.draft.world.mover)
    return {
        "arrow": item.draft.arrow, "point": rounded(camera.project(np.array(mover.centre)), 2),
        "bbox": rounded(box_of(camera, mover, *still(mover)), 2), "direction": rounded(direction_of(item), 6),
        "fps": FPS, "track": rounded(camera.project(item.run.centres[mover.name]), 2),
        "boxes": {t.name: rounded(boxes_of(item, t), 1) for t in things},
        "id_of": id_numbers(item), "future": list(FUTURE),
        "trail": rounded(camera.project(trail_of(item.draft)), 2) if item.draft.trail_times else [],
        "camera": camera_of(camera),
    }  # fmt: skip


def motion(item: Accepted) -> dict:
    """What happens: metres, seconds, touches."""
    world, table = item.draft.world, item.draft.world.table
    factual = item.factual
    return {
        "hits": hits_of(item, item.run), "contacts": contacts_of(item.run),
        "gaps": {name: round(gap, 4) for name, gap in item.run.gaps.items() if name != world.removed},
        "hidden": None if item.hidden is None else round(item.hidden, 4), "v0": rounded(np.array(world.velocity), 6),
        "table": {"centre": list(table.centre), "height": table.height, "yaw": table.yaw} if table else None,
        "removed": world.removed, "chain": chain_of(item), "fit": fit_of(item), "world": world_of(item.run),
        "factual": factual and {
            "hits": hits_of(item, factual), "contacts": contacts_of(factual), "world": world_of(factual)
        },
    }  # fmt: skip


def meta_of(item: Accepted, arrow: Arrow | None) -> dict:
    """The whole record of an item."""
    style = arrow and {
        "colour": arrow.colour, "style": arrow.style, "thickness": arrow.thickness, "along": arrow.along
    }  # fmt: skip
    objects = {
        t.name: {"shape": t.shape, "colour": t.colour, "scale": round(t.scale, 4), "yaw": round(t.yaw, 5)}
        for t in item.draft.world.things
    }
    return {**naming(item.key, item), **geometry(item), **motion(item), "arrow_style": style, "objects": objects}
