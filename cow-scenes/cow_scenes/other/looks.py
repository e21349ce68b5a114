"""What a scene of the second family looks like: textures, lights, surroundings, backdrops, and the camera's flaws."""

import io
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFilter

TEXELS = 512
WOODS = ((150, 104, 64), (112, 74, 46), (190, 150, 104), (92, 70, 56))
CLUTTER = ((128, 112, 96), (98, 84, 72), (96, 106, 100), (118, 104, 110), (110, 104, 92))
"""Colours that no question names."""
PLAIN = ((196, 190, 180), (168, 172, 176), (142, 132, 120), (206, 200, 186), (120, 126, 128))
MUTED = (*PLAIN, (98, 84, 72), (84, 92, 88), (150, 138, 142), (112, 104, 92), (70, 74, 80))
SURROUNDINGS = ("room", "table top", "outdoors")
MOST_PITCH = 38.0
"""Degrees down up to which a table top has its backdrop: below it, a camera sees a floor there."""
PHOTOGRAPHS = ("astronaut", "chelsea", "coffee", "rocket")
"""Pictures inside scikit-image's wheel, by their names there: CC0 (chelsea, coffee) or in the public domain."""
SCANS = {"grass": (92, 128, 60), "gravel": (150, 144, 136), "brick": (166, 104, 84)}
"""Grey CC0 textures of the same wheel, and the colours that we give them."""


def noise(random: np.random.Generator, power: float, stretch: float = 1.0, size: int = TEXELS) -> np.ndarray:
    """Periodic noise (size, size) with mean 0 and deviation 1 whose spectrum falls with a power of the frequency."""
    y, x = np.meshgrid(np.fft.fftfreq(size) * size, np.fft.fftfreq(size) * size, indexing="ij")
    falling = np.maximum(np.hypot(x * stretch, y), 1.0) ** -power
    made = np.fft.ifft2(np.fft.fft2(random.normal(size=(size, size))) * falling).real
    return (made - made.mean()) / made.std()


def shaded(colour: tuple[int, int, int], light: np.ndarray) -> np.ndarray:
    """A texture (n, n, 3) uint8: a colour times a brightness (n, n)."""
    return np.clip(np.array(colour) * light[..., None], 0, 255).astype(np.uint8)


def scan(name: str) -> np.ndarray:
    """One of scikit-image's pictures."""
    # Slow to import, and not needed to run a world.
    from skimage import data  # noqa: PLC0415

    return np.asarray(getattr(data, name)())


def floor_texture(random: np.random.Generator, kind: str) -> np.ndarray:
    """A floor's texture (512, 512, 3) uint8."""
    y, x = np.mgrid[:TEXELS, :TEXELS]
    if kind in SCANS:
        grey = scan(kind) / 255.0
        return shaded(SCANS[kind], 1 + 0.8 * (grey - grey.mean()))
    if kind == "wood":
        count = int(random.integers(3, 7))
        plank = y * count // TEXELS
        grain = noise(random, 1.2, 0.06) * 0.06 + random.uniform(0.82, 1.15, count)[plank]
        gap = (y * count % TEXELS < 8) | ((x + plank * 197) % TEXELS < 3)
        return shaded(WOODS[int(random.integers(len(WOODS)))], np.where(gap, 0.45, grain))
    if kind == "tiles":
        count = int(random.integers(2, 5))
        tone = random.uniform(0.86, 1.08, (count, count))[y * count // TEXELS, x * count // TEXELS]
        gap = (y * count % TEXELS < 4 * count) | (x * count % TEXELS < 4 * count)
        return shaded(pick(random, PLAIN), np.where(gap, 0.62, tone + noise(random, 1.4) * 0.03))
    strength, power = {"carpet": (0.13, 0.3), "stone": (0.10, 1.3), "cloth": (0.03, 0.6)}[kind]
    light = 1 + noise(random, power) * strength
    if kind == "cloth":
        light = light * np.where((x // 32 + y // 32) % 2, 1.0, random.uniform(0.8, 0.95))
    return shaded(pick(random, MUTED), light)


def pick(random: np.random.Generator, values: tuple) -> tuple:
    """One of the values."""
    return values[int(random.integers(len(values)))]


def wall_texture(random: np.random.Generator) -> np.ndarray:
    """A wall's texture: plaster, stripes or bricks."""
    colour, kind = pick(random, PLAIN), random.integers(3)
    if kind == 0:
        return floor_texture(random, "brick")
    light = 1 + noise(random, 1.2) * 0.02
    return shaded(colour, light * np.where(np.arange(TEXELS) // 32 % 2, 1, 0.9 if kind == 1 else 1.0))


def drawn_backdrop(random: np.random.Generator, width: int, height: int) -> Image.Image:
    """Something out of focus: hills under a sky, lights in the dark, or shelves."""
    kind = random.integers(3)
    top, low = (np.array(pick(random, MUTED), float) for _ in range(2))
    top = np.array([150.0, 185, 225]) if kind == 0 else top * (0.35 if kind == 1 else 1.0)
    down = np.linspace(0, 1, height)[:, None, None]
    made = Image.fromarray(np.broadcast_to(top * (1 - down) + low * down, (height, width, 3)).astype(np.uint8))
    pen = ImageDraw.Draw(made)
    if kind == 0:
        for k in range(3):
            ridge = height * (0.25 + 0.15 * k) + noise(random, 1.6, size=width)[0] * height * 0.05
            colour = tuple(int(c * (0.9 - 0.2 * k)) for c in (110, 135, 105))
            pen.polygon([(0, height), *enumerate(ridge.tolist()), (width, height)], fill=colour)
    for _ in range(0 if kind == 0 else 70):
        x, y, r = random.uniform(0, width), random.uniform(0, height), random.uniform(0.01, 0.05) * width
        colour = tuple(int(c) for c in random.uniform(70, 230, 3)) if kind == 1 else pick(random, MUTED)
        shelf = height / 5 * (1 + int(y / height * 5))
        box = (
            (x - r, y - r, x + r, y + r) if kind == 1 else (x, shelf - height * random.uniform(0.1, 0.17), x + r, shelf)
        )
        (pen.ellipse if kind == 1 else pen.rectangle)(box, fill=colour)
    return made.filter(ImageFilter.GaussianBlur(width * random.uniform(0.004, 0.012)))


def photographed_backdrop(random: np.random.Generator, width: int, height: int, avoid: frozenset[str]) -> Image.Image:
    """A cutting of a photograph, slightly out of focus; `coffee` shows a cup and is left out next to other objects."""
    names = tuple(n for n in PHOTOGRAPHS if not (n == "coffee" and avoid & {"mug", "bowl", "pot"}))
    photograph = Image.fromarray(scan(str(pick(random, names))))
    scale = max(width / photograph.width, height / photograph.height) * random.uniform(1.0, 1.4)
    large = photograph.resize((int(photograph.width * scale) + 1, int(photograph.height * scale) + 1))
    x, y = int(random.integers(large.width - width + 1)), int(random.integers(large.height - height + 1))
    return large.crop((x, y, x + width, y + height)).filter(
        ImageFilter.GaussianBlur(width * random.uniform(0.001, 0.006))
    )


def as_taken(picture: np.ndarray, random: np.random.Generator, grain: np.random.Generator) -> Image.Image:
    """A picture (h, w, 3) as a camera takes it: white balance, exposure, darker corners, softness, noise.

    `random` gives what all pictures of an item share, `grain` the noise of each.
    """
    height, width = picture.shape[:2]
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    gain = random.uniform(0.92, 1.08) * (1 + random.uniform(-1, 1) * np.array([0.05, 0.0, -0.05]))
    light = picture / 255 * gain * (1 - random.uniform(0, 0.22) * (x * x + y * y) / 2)[..., None]
    bent = np.clip(light, 0, 1) ** random.uniform(0.85, 1.1) * 255
    soft = Image.fromarray(bent.astype(np.uint8)).filter(ImageFilter.GaussianBlur(random.uniform(0, 0.7) * width / 832))
    noisy = np.asarray(soft, float) + grain.normal(size=picture.shape) * random.uniform(0.5, 5)
    return Image.fromarray(np.clip(noisy, 0, 255).astype(np.uint8))


@dataclass(frozen=True)
class Look:
    """MuJoCo's XML of lights, materials, floor, walls and clutter; PNG files by name; the picture behind it all."""

    assets: str
    bodies: str
    visual: str
    files: dict[str, bytes]
    backdrop: Image.Image


def png(texture: np.ndarray) -> bytes:
    """A texture as a PNG file."""
    file = io.BytesIO()
    Image.fromarray(texture).save(file, "PNG", compress_level=1)
    return file.getvalue()


def rgba(colour: tuple) -> str:
    """A colour of 0 to 255 as MuJoCo wants it."""
    return " ".join(f"{c / 255:.3f}" for c in colour) + " 1"


def lights(random: np.random.Generator, reach: float, yaw: float) -> tuple[str, str]:
    """Lamps with shadows on the camera's side of a scene, and the even light: XML of the world and of `visual`."""
    made, count = "", int(random.integers(1, 4))
    for k in range(count):
        lean, turn = random.uniform(0.25, 0.9), yaw + np.pi + random.uniform(-1.5, 1.5)
        way = np.array([np.cos(turn) * lean, np.sin(turn) * lean, 1.0])
        at, bright = way * reach * 3.5, (0.75 if k == 0 else 0.35) / (1 + 0.25 * (count - 1))
        warm = bright * (1 + random.uniform(-1, 1) * np.array([0.10, 0.0, -0.12]))
        made += (
            f'<light pos="{at[0]:.3f} {at[1]:.3f} {at[2]:.3f}" dir="{-way[0]:.3f} {-way[1]:.3f} -1" '
            f'directional="{"true" if k == 0 else "false"}" cutoff="60" exponent="1" castshadow="true" '
            f'diffuse="{warm[0]:.3f} {warm[1]:.3f} {warm[2]:.3f}" specular="0.3 0.3 0.3"/>'
        )
    even = random.uniform(0.28, 0.42)
    return made, f'<headlight ambient="{even:.3f} {even:.3f} {even:.3f}" diffuse="0.15 0.15 0.15" specular="0 0 0"/>'


def clutter(random: np.random.Generator, reach: float, far: float, yaw: float) -> str:
    """Boxes, posts and globes in muted colours behind a scene, `far` metres away from its middle."""
    made = ""
    for _ in range(int(random.integers(0, 9))):
        size = random.uniform(0.08, 0.3, 3) * reach
        kind = str(pick(random, ("box", "box", "cylinder", "ellipsoid")))
        turn, away = yaw + random.uniform(-0.9, 0.9), far + size.max() * 1.5 + random.uniform(0, 0.6) * reach
        height = size[1] if kind == "cylinder" else size[2]
        made += (
            f'<geom type="{kind}" size="{size[0]:.3f} {size[1]:.3f} {size[2]:.3f}" material="plain" '
            f'pos="{away / np.cos(turn - yaw) * np.cos(turn):.3f} {away / np.cos(turn - yaw) * np.sin(turn):.3f} '
            f'{height:.3f}" euler="0 0 {random.uniform(0, 90):.1f}" rgba="{rgba(pick(random, CLUTTER))}"/>'
        )
    return made


def wall(reach: float, turn: float, away: float) -> str:
    """A wall that faces the middle from `away` metres."""
    x, y = np.cos(turn), np.sin(turn)
    # What is not quite opaque casts no shadow, which would cover the wall itself with a moire pattern.
    return (
        f'<geom type="plane" size="{8 * reach:.3f} {4 * reach:.3f} 1" material="wall" rgba="1 1 1 0.999" '
        f'pos="{x * away:.3f} {y * away:.3f} {4 * reach:.3f}" xyaxes="{y:.6f} {-x:.6f} 0 0 0 1"/>'
    )


def materials(repeat: float, shine: float) -> str:
    """Textures and materials: those of floor and wall repeat per metre, the floor mirrors as it shines."""
    return (
        '<texture name="floor" type="2d" file="floor.png"/><texture name="wall" type="2d" file="wall.png"/>'
        '<texture name="grain" type="cube" file="grain.png"/><texture name="weave" type="cube" file="weave.png"/>'
        f'<material name="floor" texture="floor" texuniform="true" texrepeat="{repeat:.3f} {repeat:.3f}" '
        f'reflectance="{shine:.3f}" specular="{shine:.3f}" shininess="0.5"/>'
        f'<material name="wall" texture="wall" texuniform="true" texrepeat="{repeat:.3f} {repeat:.3f}" specular="0"/>'
        '<material name="plain" texture="grain" specular="0.1"/>'
    )


def look_of(
    random: np.random.Generator, reach: float, extent: np.ndarray, yaw: float, size: tuple[int, int], pitch: float,
    avoid: frozenset[str],
) -> Look:  # fmt: skip
    """The surroundings of a scene about the origin, `reach` metres wide to each side.

    The camera looks towards `yaw` and `pitch` degrees down. `extent` are points (n, 2) on the floor that things pass:
    walls and clutter are beyond them. `avoid` are nouns that a photographed backdrop may not show.
    """
    kind = str(pick(random, SURROUNDINGS if pitch < MOST_PITCH else ("room", "outdoors")))
    floors = {"room": ("wood", "tiles", "carpet", "stone"), "table top": ("wood", "cloth", "stone"),
              "outdoors": ("grass", "gravel", "brick", "stone", "tiles")}[kind]  # fmt: skip
    ahead = np.array([np.cos(yaw), np.sin(yaw)])
    far = max(float((extent @ ahead).max()), reach) + 0.25 * reach
    bodies, visual = lights(random, reach, yaw)
    floor = str(pick(random, floors))
    files = {"floor.png": png(floor_texture(random, floor)), "wall.png": png(wall_texture(random))}
    y, x = np.mgrid[:128, :128]
    weave = 0.75 + 0.25 * np.abs(np.sin(y * np.pi / 8)) * np.where((x // 8 + y // 8) % 2, 1.0, 0.7)
    files["weave.png"] = png(shaded((255, 255, 255), weave))
    files["grain.png"] = png(shaded((255, 255, 255), 0.9 + 0.07 * noise(random, 0.9, size=128)))
    repeat, shine = random.uniform(0.6, 1.6) / reach, random.uniform(0, 0.18) * (floor in {"wood", "tiles"})
    half = np.abs(extent).max() + 0.3 * reach if kind == "table top" else 40 * reach
    bodies += (
        f'<geom type="plane" size="{half:.3f} {half:.3f} 1" material="floor" euler="0 0 {random.uniform(0, 90):.1f}"/>'
    )
    if kind != "table top":
        bodies += clutter(random, reach, far, yaw)
    if kind == "room":
        bodies += wall(reach, yaw, far + random.uniform(0.9, 2.0) * reach)
        bodies += wall(reach, yaw + np.pi / 2, far + 2.5 * reach)
    photographed = kind != "room" and random.uniform() < 0.6
    backdrop = photographed_backdrop(random, *size, avoid) if photographed else drawn_backdrop(random, *size)
    return Look(materials(repeat, shine), bodies, visual, files, backdrop)
