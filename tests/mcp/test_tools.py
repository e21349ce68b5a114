"""What tools take and return, and who may call them, without a server."""

from __future__ import annotations

import io
import json
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import numpy as np
import pytest
from conftest import EXAMPLES
from jsonschema import Draft202012Validator
from PIL import Image
from refusals import refused
from sdk import SIMULATION

from cow_service.client import AsyncClient, CowError
from cow_service.client.display import simulation_html
from cow_service.client.errors import CannotGround
from cow_service.errors import FieldError, InvalidRequest
from cow_service.mcp.arguments import MAX_FILE_BYTES, REMEDIES, error_text, image_of, input_schema, request_fields
from cow_service.media.images import encode_jpeg
from cow_service.records import Simulation
from cow_service.requests import ImageArtifact
from cow_service.settings import Settings, SettingsError

SCENE = EXAMPLES / "ball-and-mug" / "image.jpg"
PLAIN = {"image": "x", "question": "?"}


# Arguments


def test_arguments_of_the_tools_are_flat() -> None:
    given = {"image", "question", "object", "bbox", "point", "direction", "motion_kind", "speed", "num_frames", "seed"}
    given |= {"towards", "along_arrow", "forward", "cue", "distance", "duration", "until", "remove", "place"}
    given |= {"asked", "law", "objects", "objects_complete", "frames_policy", "frames_count", "generator", "reader"}
    answer = {"options", "votes", "baseline", "imagine", "imagine_votes", "imagine_threshold"}
    for tool, names in (("simulate", given | {"video"}), ("answer", given | answer)):
        schema = input_schema(tool, "Any image.")
        Draft202012Validator.check_schema(schema)
        assert set(schema["properties"]) == names
        assert (schema["required"], schema["additionalProperties"]) == (["image", "question"], False)
        assert "$ref" not in json.dumps(schema)
        assert schema["properties"]["image"] == {"type": "string", "description": "Any image."}
        assert "default" not in schema["properties"]["object"]  # null tells a model nothing
        assert schema["properties"]["objects"]["items"]["required"] == ["object", "bbox"]
    assert input_schema("simulate", "")["properties"]["video"]["default"] is False


def test_arguments_become_a_request() -> None:
    assert request_fields("simulate", PLAIN | {"seed": None, "remove": [], "place": "[]"}) == {**PLAIN, "video": False}
    full = {"point": [1, 2], "object": "cup", "motion_kind": "fall", "options": '["a","b"]', "reader": "[1]"}
    changed = {"remove": "cup", "place": [{"object": "a", "relation": "on", "targets": ["b"]}, 7]}
    assert request_fields("answer", PLAIN | full | changed) == {
        **PLAIN,
        "grounding": {"object": "cup", "point": [1, 2]},
        "motion": {"kind": "fall"},
        "options": ["a", "b"],
        "reader": "[1]",
        "interventions": [
            {"kind": "remove", "object": "cup"},
            {"kind": "place", "object": "a", "relation": "on", "targets": ["b"]},
            7,
        ],
    }
    shown = {"along_arrow": False, "forward": True, "cue": "trail", "towards": "cup"}
    assert request_fields("simulate", PLAIN | shown)["motion"] == shown
    for unknown, said in (("bBox", "bBox"), ("grounding", "grounding (instead: `object`, `bbox`, `point`)")):
        with refused("invalid-request") as caught:
            request_fields("simulate", PLAIN | {unknown: [1, 2]})
        assert said in caught.value.detail
    with refused("invalid-request", "/image", "/question"):
        request_fields("simulate", {"question": 7})


def test_images_by_whatever_names_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    digest = "ab" * 32
    for paths in (True, False):
        for name in (digest, digest.upper(), f" cow://artifacts/{digest}\n"):
            assert image_of(name, paths=paths) == ImageArtifact(artifact=digest)
        assert image_of("HTTPS://example.org/A.png", paths=paths) == "https://example.org/A.png"
        assert image_of("Data:image/png;base64,AA==", paths=paths) == "data:image/png;base64,AA=="
    odd = tmp_path / "a picture %41.jpg"
    odd.write_bytes(SCENE.read_bytes())
    assert image_of(str(odd), paths=True) == image_of(odd.as_uri(), paths=True) == SCENE.read_bytes()
    monkeypatch.setenv("HOME", str(tmp_path))
    assert image_of(f"~/{odd.name}", paths=True) == SCENE.read_bytes()
    wrong = ["/dev/zero", str(tmp_path), "ftp://x/a.png", "a\0b", "~nobody-of-that-name/a.png", "x" * 5000, __file__]
    large = tmp_path / "large.jpg"
    large.write_bytes(SCENE.read_bytes()[:100])
    with large.open("r+b") as file:
        file.truncate(MAX_FILE_BYTES + 1)
    for name, paths in (*((name, True) for name in (*wrong, str(large))), (str(odd), False)):
        with refused("invalid-request", "/image") as caught:
            image_of(name, paths=paths)
        assert len(caught.value.errors[0].detail) < 400
    with large.open("r+b") as file:
        file.truncate(MAX_FILE_BYTES)
    assert len(image_of(str(large), paths=True)) == MAX_FILE_BYTES


def test_remedies_are_for_errors_that_there_are() -> None:
    known = {kind.code for kind in CowError.__subclasses__()} | {CannotGround.code, "object-not-found"}
    assert set(REMEDIES) <= known
    faults = (FieldError("/motion/kind", "wrong"), FieldError("/grounding/bbox/3", "less"), FieldError("", "none"))
    error = InvalidRequest("-", errors=faults)
    error.request_id = "r-1"
    assert error_text(error).splitlines() == [
        f"invalid-request: {error.title}",
        "- motion_kind: wrong",
        "- bbox/3: less",
        "- arguments: none",
        "(request id r-1)",
    ]
    assert error_text(CannotGround("There is no cow.")).splitlines() == [
        f"cannot-ground: {CannotGround('').title}",
        "There is no cow.",
        f"What to do: {REMEDIES['cannot-ground']}",
    ]


# Results

NARRATION = {
    "answer": "Yes",
    "summary": "Yes, it hits the blue mug after about 1.1 s. 185 of 200 simulated versions agree.",
    "story": "The red ball bounces once and hits the blue mug after about 1.1 s.",
}


def body(name: str) -> dict[str, Any]:
    place = {"size": [0.1, 0.1, 0.1], "position": [0, 0, 2], "support": "floor", "source": "embedded", "confidence": 1}
    return {"object": name, "bbox": [5, 5, 15, 15], "shape": "sphere", **place}


def test_a_trajectory_is_told_in_words_to_a_tool_and_to_a_notebook() -> None:
    from cow_service.mcp.results import simulation_text

    contact = {"a": 0, "point": [1, 1], "impulse": 0}
    asked = {"asked": {"relation": "touches"}, "sure": True, "robust": True, "probability": 0.925, "object": "blue mug"}
    met = {"object": "blue mug", "bbox": [20, 5, 30, 15], "first_frame": 1, "kind": "touches", "probability": 0.925}
    world = {
        **{"law": "contact", "bodies": [body("red ball"), body("blue mug")], "encounters": [met]},
        "contacts": [{**contact, "b": None, "time": 0}, {**contact, "b": 1, "time": 1.125}],
        **{"ensemble": 200, "moving_until": 2.5, "outcome": asked},
    }
    old = Simulation.model_validate(SIMULATION)
    trajectory = old.trajectory.model_dump() | world
    told = Simulation.model_validate(old.model_dump() | {"trajectory": trajectory, "narration": NARRATION})
    html, text = simulation_html(told, lambda _: None), simulation_text(told, "cow://video")
    for part in ("hits blue mug after 0.1 s (185 of 200 simulated versions)", NARRATION["summary"], NARRATION["story"]):
        assert part in html
        assert part in text
    for said in (html, text):
        assert said.count("red ball and blue mug after 1.1 s") == 1
        assert "the floor after" not in said  # where it stands from the start
    assert "Nothing moves in the image from 2.5 s on" in html
    assert "Nothing moves in the image from 2.50 s on" in text
    assert (
        "at [5.0, 5.0, 15.0, 15.0] in the image of 64 x 48 px; linear, direction [1, 0] (x right, y down), 10.0 px/s"
        in text
    )
    assert "\nVideo: cow://video\n" in text
    assert "leaves the image" not in text


def picture(kind: str, size: tuple[int, int], *, noise: bool = False) -> bytes:
    buffer = io.BytesIO()
    pixels = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), np.uint8) * np.uint8(noise)
    Image.fromarray(pixels).save(buffer, kind)
    return buffer.getvalue()


def test_large_pictures_are_made_fit_for_a_model_and_small_ones_stay_as_they_are() -> None:
    from cow_service.mcp.results import fit_pictures

    ((media_type, shown),) = fit_pictures([picture("PNG", (3000, 1500))])
    assert media_type == "image/png"
    with Image.open(io.BytesIO(shown)) as small:
        assert small.size == (1024, 512)
    assert fit_pictures([shown]) == [("image/png", shown)]
    overlay, frame = encode_jpeg(np.zeros((200, 300, 3), np.uint8)), picture("PNG", (300, 200))
    assert fit_pictures([overlay, frame]) == [("image/jpeg", overlay), ("image/png", frame)]


def test_pictures_of_photographs_fit_into_a_message(monkeypatch: pytest.MonkeyPatch) -> None:
    from cow_service.mcp import results

    assert results.MAX_BYTES == 500_000
    noise = picture("PNG", (400, 300), noise=True)
    for most, size in {300_000: (400, 300), 80_000: (300, 225), 10_000: (140, 105), 2_000: (60, 45)}.items():
        monkeypatch.setattr(results, "MAX_BYTES", most)
        shown = results.fit_pictures([noise] * 2)
        assert [media_type for media_type, _ in shown] == ["image/jpeg"] * 2
        assert sum(len(data) for _, data in shown) <= most
        assert {Image.open(io.BytesIO(data)).size for _, data in shown} == {size}


# Callers


def test_names_by_which_it_may_be_asked() -> None:
    from cow_service.mcp.serving import protection

    security = protection("::", ["Cow.Example", "10.0.0.7:8443"])
    assert security.enable_dns_rebinding_protection
    assert {"localhost:*", "[::1]", "cow.example", "cow.example:*", "10.0.0.7:8443"} <= set(security.allowed_hosts)
    assert "::" not in security.allowed_hosts
    assert "https://cow.example" in security.allowed_origins
    assert "[fd00::1]:*" in protection("fd00::1", []).allowed_hosts


def test_our_own_key_is_not_lent_to_others(monkeypatch: pytest.MonkeyPatch) -> None:
    from cow_service.mcp.server import Caller
    from cow_service.mcp.serving import with_own_keys

    monkeypatch.setenv("COW_API_KEY", "ours")

    @asynccontextmanager
    async def way(_: Caller) -> AsyncGenerator[AsyncClient]:
        yield AsyncClient("http://cow")

    async def asked(caller: Caller, everybody: bool) -> None:
        async with with_own_keys(way, everybody=everybody)(caller) as client:
            await client.close()

    anyio.run(asked, Caller("theirs"), True)
    anyio.run(asked, Caller(), False)
    anyio.run(asked, Caller("theirs", forwarded=True), False)
    for caller, everybody in ((Caller(), True), (Caller(forwarded=True), False)):
        with refused("unauthorized"):
            anyio.run(asked, caller, everybody)


def test_a_server_of_ones_own_has_no_keys(tmp_path: Path) -> None:
    from cow_service.mcp.serving import backend_for, for_its_owner

    limits = {"rate_limit": 1, "rate_limit_mb": 1, "rate_limit_cpu": 1, "shutdown_grace": 9.0}
    keys = {"alice": "sha256:" + "0" * 64}
    settings = Settings(data_dir=tmp_path, api_keys=keys, cors_origins=("*",), host="0.0.0.0", **limits)
    own = for_its_owner(settings)
    assert (own.api_keys, own.cors_origins, own.host, own.data_dir) == ({}, (), "127.0.0.1", tmp_path)
    assert (own.rate_limit, own.rate_limit_mb, own.rate_limit_cpu, own.shutdown_grace) == (None, None, None, 0.0)
    with pytest.raises(SettingsError, match="http"):
        backend_for(settings, "cow.example")
