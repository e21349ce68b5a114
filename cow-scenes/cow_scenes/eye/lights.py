"""The light of a picture, and what a camera makes of it: exposure, tint, darker corners, softness."""

from dataclasses import dataclass

import cv2
import mujoco
import numpy as np

from .meshes import Random
from .stage import HEIGHT, LIGHTS, WIDTH, Stage


@dataclass(frozen=True)
class Lamps:
    """Offsets (n, 3) of the lamps from the origin in metres, and the radius over which each is spread."""

    offsets: np.ndarray
    spread: float

    @property
    def towards_first(self) -> np.ndarray:
        """The direction to the strongest lamp."""
        return self.offsets[0] / np.linalg.norm(self.offsets[0])


def light(stage: Stage, random: Random) -> Lamps:
    """One to three lamps, sun or spot, white or coloured, above what is seen; the rest comes from all around."""
    model, count, tint = stage.model, int(random.integers(1, LIGHTS + 1)), 0.3 if random.random() < 0.25 else 0.1
    around, offsets = random.uniform(0.05, 0.55), []
    model.vis.headlight.ambient[:] = around * np.clip(1 + random.normal(0, tint, 3), 0.3, 1.5)
    model.vis.headlight.diffuse[:] = random.uniform(0, 0.35) if random.random() < 0.5 else 0
    model.vis.headlight.specular[:] = 0
    for k in range(LIGHTS):
        azimuth, height = random.uniform(0, 2 * np.pi), np.radians(random.uniform(18, 85))
        way = np.array([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)])
        is_sun, is_on = random.random() < 0.5, k < count
        offsets.append(way * (4 if is_sun else random.uniform(1.0, 4)))
        strength = random.uniform(0.3, 0.95) if k == 0 else random.uniform(0.05, 0.45)
        kinds = mujoco.mjtLightType
        model.light_type[k] = (kinds.mjLIGHT_DIRECTIONAL if is_sun else kinds.mjLIGHT_SPOT).value
        model.light_diffuse[k] = np.clip(1 + random.normal(0, tint, 3), 0.2, 1.6) * strength * is_on
        model.light_specular[k], model.light_ambient[k] = random.uniform(0, 0.7) * is_on, 0
        model.light_active[k], model.light_castshadow[k] = is_on, is_on and k < 2 and random.random() < 0.9
        model.light_cutoff[k], model.light_exponent[k] = (
            random.choice((80, 80, random.uniform(20, 50))),
            random.uniform(0, 4),
        )
    lamps = Lamps(np.array(offsets), random.choice((0.0, random.uniform(0.05, 0.6))))
    hang(stage, lamps, np.zeros((LIGHTS, 3)))
    return lamps


def hang(stage: Stage, lamps: Lamps, shifts: np.ndarray) -> None:
    """Put the lamps at their places, each shifted by some metres; all shine at the origin."""
    stage.model.light_pos[:] = lamps.offsets + shifts
    stage.model.light_dir[:] = -stage.model.light_pos / np.linalg.norm(stage.model.light_pos, axis=1, keepdims=True)


def expose(stage: Stage, lamps: Lamps, random: Random) -> tuple[np.ndarray, np.ndarray]:
    """The picture (h, w, 3) float32 and, at half its size, the same without shadows; no flaws of a camera, 0 to 255.

    It is the mean of two to four drawings. Each has its own shift by parts of a pixel, which softens edges, and its own
    places of the lamps, which softens shadows.
    """
    count, total = int(random.choice((2, 2, 3))), np.zeros((HEIGHT, WIDTH, 3), np.float32)
    shifts = np.c_[np.arange(count) / count, np.arange(count) * 0.618 % 1]
    for shift in shifts - shifts.mean(0):
        hang(stage, lamps, random.normal(0, lamps.spread, (LIGHTS, 3)))
        stage.update((float(shift[0]), float(shift[1])))
        cv2.accumulate(stage.render(), total)
    hang(stage, lamps, np.zeros((LIGHTS, 3)))
    stage.update()
    return total / np.float32(count), stage.render(shadow=False, halved=True)


def develop(picture: np.ndarray, random: Random) -> np.ndarray:
    """The picture (h, w, 3) float32 as a camera takes it, uint8."""
    target = np.exp(random.uniform(np.log(38), np.log(175)))
    gain = np.full(3, np.clip(target / max(float(cv2.mean(picture)[1]), 5), 0.25, 5))
    if random.random() < 0.4:
        gain *= np.clip(1 + random.normal(0, 0.1, 3), 0.6, 1.4)
    made = picture * gain.astype(np.float32)
    if random.random() < 0.4:
        y, x = np.ogrid[-1 : 1 : HEIGHT * 1j, -1 : 1 : WIDTH * 1j]
        middle, strength = random.uniform(-0.4, 0.4, 2), random.uniform(0.05, 0.25)
        darker = 1 - strength * np.minimum((x - middle[0]) ** 2 + (y - middle[1]) ** 2, 2)
        made *= darker.astype(np.float32)[..., None]
    if random.random() < 0.35:
        made = cv2.GaussianBlur(made, (0, 0), random.uniform(0.4, 1.1))
    curve = 255 * (np.arange(256) / 255) ** np.exp(random.normal(0, 0.15))
    return cv2.LUT(np.clip(made, 0, 255).astype(np.uint8), curve.astype(np.uint8))
