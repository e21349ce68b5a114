"""Images: real files of every kind that is taken, and each refusal by its code."""

from __future__ import annotations

import hashlib
import io
import struct
from functools import cache

import numpy as np
import pytest
from bad_images import SIGNATURE, chunk, png16, png_of, saved, scans, with_chunks, with_segments
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from refusals import refused

from cow_service.errors import ImageTooLarge, ImageTypeUnsupported, ImageUnreadable
from cow_service.media.images import (
    MAX_JPEG_SEGMENTS,
    MAX_PNG_CHUNKS,
    MIN_SIDE,
    check,
    decode,
    decode_data_url,
    decode_own,
    encode_jpeg,
    encode_png,
    fit_within,
)

WHITE, BLACK = (255, 255, 255), (0, 0, 0)
COLOURS = {"R": (255, 0, 0), "G": (0, 255, 0), "B": (0, 0, 255), "Y": (255, 255, 0)}
FORMATS = ["PNG", "JPEG", "WEBP"]
ORIENTATION, EXIF_DIRECTORY, FOCAL_ON_FILM = 0x0112, 0x8769, 0xA405


def quadrants(width: int = 40, height: int = 24, order: str = "RGBY") -> Image.Image:
    """Four colours: top left, top right, bottom left, bottom right."""
    pixels = np.array([COLOURS[name] for name in order], np.uint8).reshape(2, 2, 3)
    return Image.fromarray(pixels.repeat(height // 2, axis=0).repeat(width // 2, axis=1))


def shown_by(data: bytes) -> tuple[str, tuple[int, ...]]:
    """The order of the quadrants that a file shows, and the shape of its picture."""
    pixels = decode(data).pixels.astype(int)
    # The middle of a quadrant is away from the ringing of the lossy formats.
    rows, columns = (slice(side // 4, None, side // 2) for side in pixels.shape[:2])
    order = ""
    for pixel in pixels[rows, columns].reshape(-1, 3):
        (name,) = [name for name, rgb in COLOURS.items() if np.abs(pixel - rgb).max() < 40]
        order += name
    return order, pixels.shape


def with_exif(orientation: int, focal: int | None = None) -> Image.Exif:
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    if focal is not None:
        exif.get_ifd(EXIF_DIRECTORY)[FOCAL_ON_FILM] = focal
    return exif


@pytest.mark.parametrize("kind", FORMATS)
def test_each_type_is_decoded_to_upright_rgb(kind: str) -> None:
    data = saved(quadrants(), kind)
    decoded = decode(data)
    assert check(data) == decoded.media_type == f"image/{kind.lower()}"
    assert decoded.pixels.dtype == np.uint8
    assert decoded.pixels.flags.c_contiguous
    assert decoded.info.model_dump() == {
        "width": 40, "height": 24, "sha256": hashlib.sha256(data).hexdigest(), "focal": None
    }  # fmt: skip
    assert shown_by(data) == ("RGBY", (24, 40, 3))


# What a stored picture of red, green, blue and yellow quadrants shows (EXIF 2.3, section 4.6.4).
@pytest.mark.parametrize(
    ("orientation", "order"),
    {1: "RGBY", 2: "GRYB", 3: "YBGR", 4: "BYRG", 5: "RBGY", 6: "BRYG", 7: "YGBR", 8: "GYRB", 42: "RGBY"}.items(),
)
def test_exif_orientation(orientation: int, order: str) -> None:
    shape = (40, 24, 3) if 5 <= orientation <= 8 else (24, 40, 3)
    for kind in FORMATS:
        assert shown_by(saved(quadrants(), kind, exif=with_exif(orientation))) == (order, shape)
    # A PNG may have its EXIF block behind its pixels.
    data, block = saved(quadrants()), chunk(b"eXIf", with_exif(orientation).tobytes().removeprefix(b"Exif\0\0"))
    assert shown_by(data[:-12] + block + data[-12:]) == (order, shape)


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize(("millimetres", "focal"), [(4, None), (5, 50), (50, 500), (2000, 20_000), (2001, None)])
def test_the_focal_length_is_that_of_the_exif(kind: str, millimetres: int, focal: float | None) -> None:
    """It is told in mm on 35 mm film, whose frame is 36 x 24 mm."""
    data = saved(Image.new("RGB", (360, 240)), kind, exif=with_exif(6, millimetres))
    assert decode(data).info.focal == (None if focal is None else pytest.approx(focal))


def halves(mode: str, left: object, right: object) -> Image.Image:
    image = Image.new(mode, (16, 16), right)
    image.paste(left, (0, 0, 8, 16))
    return image


def palette() -> Image.Image:
    image = halves("P", 0, 1)
    image.putpalette([0, 0, 0, 10, 20, 30])
    return image


def grey16(left: int, right: int) -> np.ndarray:
    return np.repeat(np.array([[left, right]], np.uint16), 8, axis=1).repeat(16, axis=0)


HALF_RED = tuple((rgb * 128 + 255 * 127) / 255 for rgb in (200, 0, 0))
MODES = {  # the file, what its left and its right half show, and how many grey levels that may be off
    "grey": (saved(halves("L", 0, 255)), BLACK, WHITE, 0),
    "CMYK": (saved(halves("CMYK", (0, 255, 255, 0), (0, 0, 0, 0)), "JPEG", quality=95), (255, 0, 0), WHITE, 6),
    "a palette with a transparent entry": (saved(palette(), transparency=0), WHITE, (10, 20, 30), 0),
    "alpha": (saved(halves("RGBA", (200, 0, 0, 128), (200, 0, 0, 255))), HALF_RED, (200, 0, 0), 1),
    "WebP": (
        saved(halves("RGBA", (0, 0, 200, 0), (0, 0, 200, 255)), "WEBP", lossless=True), WHITE, (0, 0, 200), 0
    ),
    "a transparent grey": (saved(halves("L", 9, 5), transparency=9), WHITE, (5,) * 3, 0),
    "16 bits of grey": (png16(grey16(25700 + 128, 25700 + 129), 0), (100,) * 3, (101,) * 3, 0),
    "16 bits of grey with a transparent value": (
        with_chunks(png16(grey16(1000, 25700), 0), [chunk(b"tRNS", struct.pack(">H", 1000))]), WHITE, (100,) * 3, 0
    ),
    "16 bits of RGB": (png16(np.full((16, 16, 3), 25700, np.uint16), 2), (100,) * 3, (100,) * 3, 1),
}  # fmt: skip


@pytest.mark.parametrize(("data", "left", "right", "most"), MODES.values(), ids=MODES)
def test_every_mode_becomes_rgb_and_transparency_is_laid_on_white(data: bytes, left, right, most: int) -> None:
    pixels = decode(data).pixels.astype(int)
    for column, expected in ((3, left), (12, right)):
        assert np.abs(pixels[4, column] - expected).max() <= most


def test_the_first_picture_of_a_multi_picture_jpeg() -> None:
    data = saved(quadrants(), "MPO", save_all=True, append_images=[Image.new("RGB", (40, 24), "black")])
    assert b"MPF" in data
    assert shown_by(data)[0] == "RGBY"


@pytest.mark.parametrize("kind", ["PNG", "WEBP"])
def test_animations_are_refused(kind: str) -> None:
    data = saved(quadrants(), kind, save_all=True, append_images=[Image.new("RGB", (40, 24))])
    for read in (check, decode):
        with refused("image-type-unsupported") as caught:
            read(data)
        assert "2 frames" in caught.value.detail


def jpeg_claiming(width: int, height: int) -> bytes:
    data = saved(quadrants(), "JPEG")
    at = data.index(b"\xff\xc0") + 5
    return data[:at] + struct.pack(">HH", height, width) + data[at + 4 :]


BLANK, CLEAR = Image.new("RGB", (300, 200)), Image.new("RGBA", (300, 200), (1, 2, 3, 128))


@pytest.mark.parametrize(
    ("data", "size"),
    [
        (png_of(100_000, 100_000, 8, 2, b""), (100_000, 100_000)),
        (jpeg_claiming(60_000, 50_000), (60_000, 50_000)),
        (saved(BLANK, "WEBP"), (300, 200)),
        (saved(BLANK, "WEBP", lossless=True), (300, 200)),
        (saved(CLEAR, "WEBP"), (300, 200)),
    ],
)
def test_the_size_is_refused_from_the_header(data: bytes, size: tuple[int, int]) -> None:
    megapixels = size[0] * size[1] / 1e6
    check(data, max_megapixels=megapixels)
    with refused("image-too-large") as caught:
        check(data, max_megapixels=0.999 * megapixels)
    assert f"{size[0]} x {size[1]}" in caught.value.detail


def test_a_large_limit_is_not_overruled_by_pillow() -> None:
    # Pillow itself warns above 89 and refuses above 179 megapixels.
    with refused("image-unreadable"):
        decode(png_of(20_000, 20_000, 1, 0, b""), max_megapixels=1000)
    assert Image.MAX_IMAGE_PIXELS is not None


@pytest.mark.parametrize("kind", FORMATS)
def test_an_image_without_room_is_refused(kind: str) -> None:
    for size in ((1, 100), (100, 1), (MIN_SIDE - 1, MIN_SIDE)):
        with refused("image-unreadable"):
            check(saved(Image.new("RGB", size), kind))
    assert decode(saved(Image.new("RGB", (MIN_SIDE, MIN_SIDE)), kind)).pixels.shape == (MIN_SIDE, MIN_SIDE, 3)


@pytest.mark.parametrize(
    ("data", "name"),
    [
        (saved(quadrants(), "GIF"), "GIF"),
        (saved(quadrants(), "BMP"), "BMP"),
        (saved(quadrants(), "TIFF"), "TIFF"),
        (saved(quadrants(), "PDF"), "PDF"),
        (b'<?xml version="1.0"?>\n<svg xmlns="http://www.w3.org/2000/svg"/>', "SVG"),
        (b"\n <svg/>", "SVG"),
        (b"<!DOCTYPE html><html></html>", "HTML"),
        (b"\0\0\0\x1cftypavif\0\0\0\0", "AVIF"),
        (b"\0\0\0\x18ftypheic\0\0\0\0", "HEIC"),
        (b"\0\0\0\x18ftypisom\0\0\0\0", "ISO media"),
        (b"iVBORw0KGgoAAAANSUhEUg==", "base64"),
        (b"data:image/png;base64,iVBORw0KGgo", "data URL"),
        ("Eine Kuh f\u00e4llt.\n".encode() * 200, "text"),
        (b"\x00\x01\x02\x03\xfe", "00 01 02 03 fe"),
        (b"RIFF\x10\0\0\0WAVEfmt ", "52 49 46 46"),
    ],
)
def test_other_types_are_refused_by_name(data: bytes, name: str) -> None:
    with refused("image-type-unsupported") as caught:
        check(data)
    assert name in caught.value.detail


MAGIC = (SIGNATURE, b"\xff\xd8\xff", b"RIFF\x10\0\0\0WEBP", b"RIFF....WEBPVP8 ")
NOISE = Image.fromarray(np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8))


def test_what_holds_no_picture_is_refused() -> None:
    halved = [data[: len(data) // 2] for data in (saved(NOISE, kind) for kind in FORMATS)]
    for data in (b"", *halved, *(magic + body for magic in MAGIC for body in (b"", b"\0" * 100, b"\xff" * 100))):
        with refused("image-unreadable"):
            decode(data)


def test_files_of_more_parts_than_programs_write_are_refused() -> None:
    png, jpeg, progressive = saved(NOISE), saved(NOISE, "JPEG"), saved(NOISE, "JPEG", progressive=True)
    empty, comment = chunk(b"prVt", b""), b"\xff\xfe\0\2"
    own, parts, own_scans = 3, 8, progressive.count(b"\xff\xda")  # of the files themselves
    check(with_chunks(png, [empty] * (MAX_PNG_CHUNKS - own)))
    check(with_segments(jpeg, comment * (MAX_JPEG_SEGMENTS - parts - 2)))
    check(scans(progressive, 100 - own_scans))
    for data in (
        with_chunks(png, [empty] * (MAX_PNG_CHUNKS - own + 1)),
        with_segments(jpeg, comment * MAX_JPEG_SEGMENTS),
        scans(progressive, 101 - own_scans),
    ):
        with refused("image-unreadable"):
            check(data)


@cache
def corpus() -> list[bytes]:
    exif = with_exif(6)
    exif[0x010F] = "camera"
    picture = quadrants(48, 40)
    animated = {"save_all": True, "append_images": [Image.new("RGB", (48, 40))]}
    return [
        saved(picture, exif=exif, dpi=(72, 72)),
        saved(picture.convert("P"), transparency=0),
        png16(np.arange(20 * 20, dtype=np.uint16).reshape(20, 20) * np.uint16(150), 0),
        saved(picture, "JPEG", exif=exif, icc_profile=b"not a profile"),
        saved(picture, "JPEG", progressive=True),
        saved(picture, "MPO", **animated),
        saved(picture, "WEBP", exif=exif),
        saved(picture, "WEBP", **animated),
    ]


def decodes_or_refuses(data: bytes) -> None:
    try:
        decoded = decode(data)
    except (ImageTooLarge, ImageTypeUnsupported, ImageUnreadable):
        return
    assert decoded.pixels.shape == (decoded.info.height, decoded.info.width, 3)


@given(
    st.integers(0, 7),
    st.floats(0, 1),
    st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), max_size=8),
)
def test_any_change_of_any_prefix_is_decoded_or_refused(index: int, share: float, changes: list) -> None:
    data = corpus()[index]
    changed = bytearray(data[: max(1, round(share * len(data)))])
    for place, value in changes:
        changed[int(place * len(changed))] = value
    decodes_or_refuses(bytes(changed))


@given(st.sampled_from((b"", *MAGIC)), st.binary(max_size=64))
def test_any_bytes_are_decoded_or_refused(magic: bytes, data: bytes) -> None:
    decodes_or_refuses(magic + data)


def test_encode_png_keeps_every_pixel() -> None:
    rgba = np.random.default_rng(1).integers(0, 256, (600, 13, 4), np.uint8)  # more rows than are copied together
    for level in (0, 1, 9):
        np.testing.assert_array_equal(decode(encode_png(rgba[..., :3], level=level)).pixels, rgba[..., :3])
    for pixels in (rgba, rgba[..., 1], rgba[..., 1].astype(np.uint16) * np.uint16(257)):
        np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(encode_png(pixels)))), pixels)
    mask = rgba[..., 0] > 99
    image = Image.open(io.BytesIO(encode_png(mask)))
    assert image.mode == "1", "one bit per pixel"
    np.testing.assert_array_equal(np.asarray(image), mask)
    np.testing.assert_array_equal(decode_own(encode_png(mask)), np.where(mask, 255, 0)[..., None].repeat(3, axis=2))
    with refused("internal-error"):
        decode_own(b"\0")
    for shape in ((4,), (4, 4, 5), (0, 4, 3)):
        with pytest.raises(ValueError, match="shape"):
            encode_png(np.zeros(shape, np.uint8))


def test_a_jpeg_keeps_the_colours_of_thin_lines() -> None:
    pixels = np.full((64, 64, 3), 128, np.uint8)
    pixels[:, 31] = (255, 0, 0)
    assert np.abs(decode(encode_jpeg(pixels)).pixels[32, 31].astype(int) - (255, 0, 0)).max() < 30


def test_fit_within_keeps_the_form_averages_and_takes_grey() -> None:
    for size, most, expected in (
        ((100, 50), 40, (40, 20)),
        ((50, 100), 40, (20, 40)),
        ((1000, 1), 10, (10, 1)),
        ((30, 20), 30, (30, 20)),
        ((30, 20), None, (30, 20)),
    ):
        fitted = fit_within(np.full((*size, 3), 9, np.uint8), most)
        assert (fitted.shape, fitted.dtype) == ((*expected, 3), np.uint8)
        assert (fitted == 9).all()
    checks = np.indices((64, 64)).sum(axis=0).astype(np.uint8) % 2 * np.uint8(200)
    assert np.abs(fit_within(checks, 16).astype(int) - 100).max() <= 1


def test_the_bytes_of_a_data_url() -> None:
    for head in ("data:image/png", "data:image/png;charset=x", "data:", "data:application/octet-stream"):
        assert decode_data_url(f"{head};base64,aG\nk=") == b"hi"
    for bad in ("x", "data:image/png,abc", "data:image/png;base64,***", "data:"):
        with refused("invalid-request", "/objects/0/mask"):
            decode_data_url(bad, "/objects/0/mask")
    with refused("image-type-unsupported"):
        decode_data_url("data:text/html;base64,aGk=")
