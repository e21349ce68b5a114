"""Images: real files of every kind that is taken, and each refusal by its code."""

from __future__ import annotations

import hashlib
import io
import struct
import threading
import zlib
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from cow_service.errors import CowError, ImageTooLarge, ImageTypeUnsupported, ImageUnreadable
from cow_service.media.images import MIN_SIDE, DecodedImage, decode, decode_own, encode_png, fit_within

WHITE = [255, 255, 255]
BLACK = [0, 0, 0]
FORMATS = ["PNG", "JPEG", "WEBP"]


def saved(image: Image.Image, kind: str = "PNG", **options) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def png(width: int, height: int, depth: int, colour_type: int, rows: bytes, between: bytes = b"") -> bytes:
    header = struct.pack(">IIBBBBB", width, height, depth, colour_type, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + between
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


def png16(values: np.ndarray, colour_type: int, between: bytes = b"") -> bytes:
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    return png(values.shape[1], values.shape[0], 16, colour_type, rows, between)


def quadrants(width: int = 40, height: int = 24) -> Image.Image:
    pixels = np.zeros((height, width, 3), np.uint8)
    pixels[: height // 2, : width // 2] = [255, 0, 0]
    pixels[: height // 2, width // 2 :] = [0, 255, 0]
    pixels[height // 2 :, : width // 2] = [0, 0, 255]
    pixels[height // 2 :, width // 2 :] = [255, 255, 0]
    return Image.fromarray(pixels)


def refused(data: bytes, error: type[CowError], **options) -> str:
    with pytest.raises(error) as caught:
        decode(data, **options)
    assert type(caught.value) is error
    return caught.value.detail


@pytest.mark.parametrize("kind", FORMATS)
def test_each_type_is_decoded_to_upright_rgb(kind):
    data = saved(quadrants(), kind)
    decoded = decode(data)
    assert decoded.pixels.shape == (24, 40, 3)
    assert decoded.pixels.dtype == np.uint8
    assert decoded.pixels.flags.c_contiguous
    assert (decoded.info.width, decoded.info.height) == (40, 24)
    assert decoded.info.sha256 == hashlib.sha256(data).hexdigest()
    # The middle of a quadrant is away from the ringing of the lossy formats.
    assert np.abs(decoded.pixels[4, 8].astype(int) - [255, 0, 0]).max() <= 12
    assert np.abs(decoded.pixels[18, 32].astype(int) - [255, 255, 0]).max() <= 12


# Where the pixel that is stored at the top left is shown, as (bottom?, right?), and whether the sides swap
# (EXIF 2.3, section 4.6.4).
SHOWN = {
    1: (False, False, False),
    2: (False, True, False),
    3: (True, True, False),
    4: (True, False, False),
    5: (False, False, True),
    6: (False, True, True),
    7: (True, True, True),
    8: (True, False, True),
}


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("orientation", SHOWN)
def test_exif_orientation(orientation, kind):
    bottom, right, swapped = SHOWN[orientation]
    stored = np.full((16, 32, 3), 255, np.uint8)
    stored[:8, :8] = [255, 0, 0]
    stored[:8, 24:] = [0, 0, 255]
    exif = Image.Exif()
    exif[0x0112] = orientation
    pixels = decode(saved(Image.fromarray(stored), kind, exif=exif)).pixels.astype(int)
    assert pixels.shape[:2] == ((32, 16) if swapped else (16, 32))
    red = pixels[-4 if bottom else 3, -4 if right else 3]
    assert red[0] > 180
    assert red[2] < 80
    # The stored top right moves along the stored row: down the shown column if the sides swap.
    blue_bottom, blue_right = (not bottom, right) if swapped else (bottom, not right)
    blue = pixels[-4 if blue_bottom else 3, -4 if blue_right else 3]
    assert blue[2] > 180
    assert blue[0] < 80


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("orientation", [1, 6])
def test_the_focal_length_is_that_of_the_exif(kind, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769)[0xA405] = 50  # mm on 35 mm film, whose frame is 36 x 24 mm
    decoded = decode(saved(Image.new("RGB", (360, 240)), kind, exif=exif))
    assert decoded.info.focal == pytest.approx(500, rel=0.001)
    assert decode(saved(Image.new("RGB", (360, 240)), kind)).info.focal is None


def test_an_orientation_out_of_range_is_ignored():
    exif = Image.Exif()
    exif[0x0112] = 42
    assert decode(saved(quadrants(), "JPEG", exif=exif)).pixels.shape == (24, 40, 3)


def test_orientation_from_an_exif_block_behind_the_pixels_of_a_png():
    exif = Image.Exif()
    exif[0x0112] = 6
    block = chunk(b"eXIf", exif.tobytes().removeprefix(b"Exif\0\0"))
    data = saved(quadrants())
    assert decode(data[:-12] + block + data[-12:]).pixels.shape == (40, 24, 3)


def test_16_bit_grey_is_scaled_not_clipped():
    values = np.linspace(0, 65535, 16 * 16).round().reshape(16, 16).astype(np.uint16)
    pixels = decode(png16(values, 0)).pixels
    np.testing.assert_array_equal(pixels, np.repeat(np.round(values / 257)[..., None], 3, axis=2))
    np.testing.assert_array_equal(decode(saved(Image.fromarray(values))).pixels, pixels)


def test_16_bit_grey_with_a_transparent_value():
    values = np.full((8, 8), 1000, np.uint16)
    values[0, 0] = 25700
    pixels = decode(png16(values, 0, chunk(b"tRNS", struct.pack(">H", 1000)))).pixels
    assert pixels[0, 0].tolist() == [100, 100, 100]
    assert pixels[5, 5].tolist() == WHITE


@pytest.mark.parametrize(("colour_type", "channels"), [(2, 3), (6, 4), (4, 2)])
def test_16_bit_colour_and_alpha(colour_type, channels):
    values = np.full((8, 8, channels), 65535, np.uint16)
    values[..., 0] = 25700
    pixels = decode(png16(values, colour_type)).pixels
    expected = [100, 255, 255] if channels > 2 else [100, 100, 100]
    assert np.abs(pixels[3, 3].astype(int) - expected).max() <= 1


def test_cmyk_jpeg():
    cmyk = Image.new("CMYK", (16, 16), (0, 255, 255, 0))
    assert np.abs(decode(saved(cmyk, "JPEG", quality=95)).pixels[8, 8].astype(int) - [255, 0, 0]).max() <= 6


@pytest.mark.parametrize("mode", ["L", "1", "P"])
def test_modes_without_colour_become_rgb(mode):
    image = Image.new("L", (16, 16), 255)
    image.paste(0, (0, 0, 8, 16))
    pixels = decode(saved(image.convert(mode))).pixels
    assert pixels[4, 4].tolist() == BLACK
    assert pixels[4, 12].tolist() == WHITE


def test_grey_jpeg():
    assert decode(saved(Image.new("L", (16, 16), 77), "JPEG")).pixels[8, 8].tolist() == [77, 77, 77]


@pytest.mark.parametrize(("mode", "ink"), [("RGBA", (200, 0, 0)), ("LA", (40,)), ("PA", (200, 0, 0))])
def test_alpha_is_laid_on_white(mode, ink):
    image = Image.new("LA" if mode == "LA" else "RGBA", (16, 16), (*ink, 255))
    image.paste((*ink, 0), (0, 0, 5, 16))
    image.paste((*ink, 128), (5, 0, 10, 16))
    data = saved(image.quantize(16) if mode == "PA" else image)
    pixels = decode(data).pixels.astype(int)
    rgb = np.array(ink if len(ink) == 3 else ink * 3)
    assert pixels[4, 2].tolist() == WHITE
    assert np.abs(pixels[4, 7] - (rgb * 128 + 255 * 127) / 255).max() <= 3
    assert np.abs(pixels[4, 13] - rgb).max() <= 3


def test_transparent_webp_is_laid_on_white():
    image = Image.new("RGBA", (16, 16), (0, 0, 200, 0))
    assert decode(saved(image, "WEBP", lossless=True, exact=True)).pixels[3, 3].tolist() == WHITE


def test_palette_with_one_transparent_entry():
    image = Image.new("P", (16, 16), 1)
    image.putpalette([0, 0, 0, 10, 20, 30])
    image.paste(0, (0, 0, 8, 16))
    pixels = decode(saved(image, transparency=0)).pixels
    assert pixels[4, 4].tolist() == WHITE
    assert pixels[4, 12].tolist() == [10, 20, 30]


@pytest.mark.parametrize(("mode", "ink", "clear"), [("RGB", (1, 2, 3), (9, 9, 9)), ("L", 5, 9)])
def test_one_transparent_colour_without_an_alpha_channel(mode, ink, clear):
    image = Image.new(mode, (16, 16), ink)
    image.paste(clear, (0, 0, 8, 16))
    pixels = decode(saved(image, transparency=clear)).pixels
    assert pixels[4, 4].tolist() == WHITE
    assert pixels[4, 12].tolist() == (list(ink) if mode == "RGB" else [ink] * 3)


def test_the_first_picture_of_a_multi_picture_jpeg():
    second = Image.new("RGB", (40, 24), "black")
    data = saved(quadrants(), "MPO", save_all=True, append_images=[second])
    assert b"MPF" in data
    assert np.abs(decode(data).pixels[4, 8].astype(int) - [255, 0, 0]).max() <= 12


@pytest.mark.parametrize("kind", ["PNG", "WEBP"])
def test_animations_are_refused(kind):
    data = saved(quadrants(), kind, save_all=True, append_images=[Image.new("RGB", (40, 24))])
    detail = refused(data, ImageTypeUnsupported)
    assert "animated" in detail
    assert "2 frames" in detail
    assert "send one frame" in detail


def webp_claiming(width: int, height: int) -> bytes:
    canvas = (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    body = b"VP8X" + struct.pack("<I", 10) + b"\0\0\0\0" + canvas
    return b"RIFF" + struct.pack("<I", len(body) + 4) + b"WEBP" + body


def jpeg_claiming(width: int, height: int) -> bytes:
    data = saved(quadrants(), "JPEG")
    at = data.index(b"\xff\xc0") + 5
    return data[:at] + struct.pack(">HH", height, width) + data[at + 4 :]


@pytest.mark.parametrize(
    ("data", "size"),
    [
        (png(100_000, 100_000, 8, 2, b""), "100000 x 100000"),
        (webp_claiming(16_000, 16_000), "16000 x 16000"),
        (jpeg_claiming(60_000, 60_000), "60000 x 60000"),
    ],
)
def test_the_size_is_refused_from_the_header(data, size):
    assert len(data) < 2000
    detail = refused(data, ImageTooLarge)
    assert size in detail
    assert "25" in detail
    assert "scale it down" in detail


def test_the_limit_is_inclusive_and_can_be_set():
    data = saved(Image.new("RGB", (100, 100)))
    assert decode(data, max_megapixels=0.01).info.width == 100
    detail = refused(data, ImageTooLarge, max_megapixels=0.009)
    assert "100 x 100" in detail
    assert "0.01 megapixels" in detail
    assert "0.009" in detail


def test_a_large_limit_is_not_overruled_by_pillow():
    # Pillow itself warns above 89 and refuses above 179 megapixels.
    huge = png(20_000, 20_000, 1, 0, b"")
    assert "damaged" in refused(huge, ImageUnreadable, max_megapixels=1000)
    assert Image.MAX_IMAGE_PIXELS is not None


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("size", [(1, 100), (100, 1), (MIN_SIDE - 1, MIN_SIDE)])
def test_an_image_without_room_is_refused(kind, size):
    assert "too small" in refused(saved(Image.new("RGB", size), kind), ImageUnreadable)


def test_the_smallest_image_is_taken():
    assert decode(saved(Image.new("RGB", (MIN_SIDE, MIN_SIDE)))).pixels.shape == (MIN_SIDE, MIN_SIDE, 3)


@pytest.mark.parametrize(
    ("data", "name"),
    [
        (saved(quadrants(), "GIF"), "a GIF file"),
        (saved(quadrants(), "BMP"), "a BMP file"),
        (saved(quadrants(), "TIFF"), "a TIFF file"),
        (saved(quadrants(), "PDF"), "a PDF file"),
        (b'<?xml version="1.0"?>\n<svg xmlns="http://www.w3.org/2000/svg"/>', "an SVG file"),
        (b"\n <svg/>", "an SVG file"),
        (b"<!DOCTYPE html><html></html>", "an HTML page"),
        (b"\0\0\0\x1cftypavif\0\0\0\0", "an AVIF file"),
        (b"\0\0\0\x18ftypheic\0\0\0\0", "a HEIC file"),
        (b"\0\0\0\x18ftypisom\0\0\0\0", "ISO media"),
        (b"iVBORw0KGgoAAAANSUhEUg==", "base64 text"),
        (b"data:image/png;base64,iVBORw0KGgo", "a data URL"),
        ("Eine Kuh f\u00e4llt.\n".encode() * 200, "text"),
        (b"\x00\x01\x02\x03\xfe", "00 01 02 03 fe"),
        (b"RIFF\x10\0\0\0WAVEfmt ", "52 49 46 46"),
    ],
)
def test_other_types_are_refused_by_name(data, name):
    detail = refused(data, ImageTypeUnsupported)
    assert name in detail
    assert "PNG, JPEG or WebP" in detail


def test_no_bytes():
    assert "empty" in refused(b"", ImageUnreadable)


@pytest.mark.parametrize("magic", [b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"RIFF\x10\0\0\0WEBP", b"RIFF....WEBPVP8 "])
def test_the_magic_bytes_alone(magic):
    for body in (b"", b"\0" * 100, b"\xff" * 100):
        assert "damaged or incomplete" in refused(magic + body, ImageUnreadable)


@pytest.mark.parametrize("kind", FORMATS)
def test_half_a_file(kind):
    data = saved(Image.fromarray(np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)), kind)
    assert str(len(data) // 2) in refused(data[: len(data) // 2], ImageUnreadable)


def fuzz_corpus() -> list[bytes]:
    exif = Image.Exif()
    exif[0x0112] = 6
    exif[0x010F] = "camera"
    picture = quadrants(48, 40)
    animated = {"save_all": True, "append_images": [Image.new("RGB", (48, 40))]}
    return [
        saved(picture, exif=exif, dpi=(72, 72)),
        saved(picture.convert("P"), transparency=0),
        png16(np.arange(20 * 20).reshape(20, 20) * 150, 0),
        saved(picture, "PNG", **animated),
        saved(picture, "JPEG", exif=exif, icc_profile=b"not a profile"),
        saved(picture, "JPEG", progressive=True),
        saved(picture.convert("CMYK"), "JPEG"),
        saved(picture, "MPO", **animated),
        saved(picture, "WEBP", exif=exif),
        saved(picture.convert("RGBA"), "WEBP", lossless=True),
        saved(picture, "WEBP", **animated),
    ]


CORPUS = fuzz_corpus()


def decodes_or_refuses(data: bytes) -> None:
    outcome: DecodedImage | CowError
    try:
        outcome = decode(data)
    except CowError as error:
        outcome = error
    if isinstance(outcome, DecodedImage):
        assert outcome.pixels.shape == (outcome.info.height, outcome.info.width, 3)
    else:
        assert outcome.code in ("image-too-large", "image-type-unsupported", "image-unreadable")
        assert "/" not in outcome.detail


@given(st.sampled_from(CORPUS), st.floats(0, 1))
def test_any_prefix_is_decoded_or_refused(data, share):
    decodes_or_refuses(data[: int(share * len(data))])


@given(st.sampled_from(CORPUS), st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), max_size=8))
def test_any_change_is_decoded_or_refused(data, changes):
    changed = bytearray(data)
    for share, value in changes:
        changed[int(share * len(data))] = value
    decodes_or_refuses(bytes(changed))


@given(st.binary(max_size=64))
def test_any_bytes_are_refused(data):
    decodes_or_refuses(data)


def test_pillows_own_warnings_are_refusals_where_warnings_are_errors():
    exif = b"Exif\0\0II*\0\x08\0\0\0\xff\xff"
    decodes_or_refuses(saved(quadrants(), "JPEG", exif=exif))


def test_decoding_from_many_threads():
    files = [saved(quadrants(64 + 8 * i, 64), kind) for i, kind in enumerate(FORMATS * 4)]
    start = threading.Barrier(4)

    def all_widths() -> list[int]:
        start.wait()
        return [decode(data).pixels.shape[1] for data in files]

    with ThreadPoolExecutor(4) as pool:
        runs = [pool.submit(all_widths) for _ in range(4)]
    assert all(run.result() == [64 + 8 * i for i in range(len(files))] for run in runs)


@pytest.mark.parametrize("level", [0, 1, 9])
def test_encode_png_keeps_every_pixel(level):
    rgb = np.random.default_rng(1).integers(0, 256, (11, 13, 3), np.uint8)
    np.testing.assert_array_equal(decode(encode_png(rgb, level=level)).pixels, rgb)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(encode_png(rgb[..., 1])))), rgb[..., 1])


def test_encode_png_of_a_mask():
    mask = np.zeros((9, 10), bool)
    mask[2:4, 3:7] = True
    image = Image.open(io.BytesIO(encode_png(mask)))
    assert image.mode == "1", "one bit per pixel"
    np.testing.assert_array_equal(np.asarray(image), mask)
    np.testing.assert_array_equal(decode_own(encode_png(mask)), np.where(mask, 255, 0)[..., None].repeat(3, axis=2))


@pytest.mark.parametrize("shape", [(4,), (4, 4, 5), (0, 4, 3)])
def test_encode_png_refuses_other_shapes(shape):
    with pytest.raises(ValueError, match=r"cannot be encoded: give"):
        encode_png(np.zeros(shape, np.uint8))


@pytest.mark.parametrize(
    ("size", "max_side", "expected"),
    [
        ((100, 50), 40, (40, 20)),
        ((50, 100), 40, (20, 40)),
        ((100, 33), 50, (50, 16)),
        ((1000, 1), 10, (10, 1)),
        ((30, 20), 30, (30, 20)),
        ((30, 20), 31, (30, 20)),
        ((30, 20), None, (30, 20)),
    ],
)
def test_fit_within(size, max_side, expected):
    width, height = size
    fitted = fit_within(np.full((height, width, 3), 9, np.uint8), max_side)
    assert fitted.shape == (expected[1], expected[0], 3)
    assert fitted.dtype == np.uint8
    assert (fitted == 9).all()


def test_fit_within_averages_and_takes_grey():
    checks = np.indices((64, 64)).sum(axis=0).astype(np.uint8) % 2 * np.uint8(200)
    assert np.abs(fit_within(checks, 16).astype(int) - 100).max() <= 1
