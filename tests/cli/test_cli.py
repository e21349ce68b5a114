"""The command line, run as a person would run it."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
from command_line import cow_from_nothing, settings_in
from drawn import ball, block, floor, png_bytes
from floors import TrueCamera, depth_png
from forked import Template, template
from PIL import Image, ImageSequence
from typer.testing import CliRunner

from cow_service import __version__
from cow_service.cli.main import app
from cow_service.cli.options import COMMANDS, FIELDS, request_body
from cow_service.records import Models, Simulation
from cow_service.requests import SimulateRequest

IMPORTED = ("cow_service.cli.console", "cow_service.api.app", "cow_service.server", "cow_service.pipeline")
QUESTION = "If the red ball moves to the right, will it hit the blue cube?"


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    path = tmp_path / "toys.png"
    path.write_bytes(
        png_bytes(block(ball(floor(), (150, 200), 40, (210, 20, 20)), (430, 160, 510, 250), (50, 80, 200)))
    )
    return path


_templates: list[Template] = []


@pytest.fixture(scope="module", autouse=True)
def _imported(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with template(tmp_path_factory.mktemp("imported"), IMPORTED, os.environ) as one:
        _templates.append(one)
        yield
        _templates.clear()


def cow(tmp_path: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """A process of its own, which in this file has what it imports from another one."""
    if not _templates:
        return cow_from_nothing(tmp_path, *arguments, **environment)
    return _templates[0].begin(arguments, tmp_path, settings_in(tmp_path, **environment)).done()


def test_simulate_writes_frames_video_overlay_and_record(tmp_path: Path, picture: Path) -> None:
    result = cow(
        tmp_path, "simulate", str(picture), QUESTION, "--num-frames", "41", "--frames", "uniform", "--count", "3",
        "--out", "out", "--format", "gif", "--format", "webp", "--format", "sheet",
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    out = tmp_path / "out"
    names = {"frame_000.png", "frame_020.png", "frame_040.png", "overlay.jpg", "simulation.json", "video.mp4"}
    assert {path.name for path in out.iterdir()} == names | {"clip.gif", "clip.webp", "sheet.png"}
    simulation = Simulation.model_validate_json((out / "simulation.json").read_text())
    assert simulation.grounding.object == "red ball"
    with Image.open(out / "frame_020.png") as frame:
        assert frame.size == (512, 320)
    for name in ("clip.gif", "clip.webp"):
        with Image.open(out / name) as clip:
            seconds = sum(frame.load() and frame.info["duration"] for frame in ImageSequence.Iterator(clip)) / 1000
            assert clip.size == (480, 300)
            assert 30 < clip.n_frames <= 41, "frames that are the same as the one before may be one of twice its length"
            assert seconds == pytest.approx(41 / 16, abs=0.05), name
    with Image.open(out / "sheet.png") as sheet:
        assert sheet.size == (4 * 320 + 3 * 4, 3 * 200 + 2 * 4)
    for told in ("grounding", "red ball at (150, 200)", "linear (+1.00, +0.00)", "hits blue cube", "41-frame video"):
        assert told in result.stdout
    assert not result.stderr


def test_no_result_of_another_picture_is_written_over_and_no_old_frame_stays(tmp_path: Path, picture: Path) -> None:
    short = ("--num-frames", "9", "--frames", "uniform", "--ensemble", "0", "--no-video", "--count")
    assert cow(tmp_path, "simulate", str(picture), QUESTION, *short, "5").returncode == 0
    (tmp_path / "toys-cow" / "notes.txt").touch()
    assert cow(tmp_path, "simulate", str(picture), QUESTION, *short, "2").returncode == 0
    names = {"frame_000.png", "frame_008.png", "overlay.jpg", "simulation.json"}
    assert {path.name for path in (tmp_path / "toys-cow").iterdir()} == names | {"notes.txt"}
    (tmp_path / "elsewhere").mkdir()
    other = tmp_path / "elsewhere" / "toys.png"
    other.write_bytes(png_bytes(ball(floor(), (150, 200), 50, (210, 20, 20))))
    for _ in range(2):  # the second time it finds its own
        result = cow(tmp_path, "simulate", str(other), "If the red ball moves right, what happens?", *short, "2")
        assert "Wrote to toys-cow-2" in result.stdout
    assert {path.name for path in (tmp_path / "toys-cow-2").iterdir()} == names
    assert {path.name for path in tmp_path.glob("toys-cow*")} == {"toys-cow", "toys-cow-2"}


def test_the_demo_needs_nothing(tmp_path: Path) -> None:
    result = cow_from_nothing(tmp_path, "demo")
    assert result.returncode == 0, result.stderr
    simulation = Simulation.model_validate_json((tmp_path / "cow-demo" / "simulation.json").read_text())
    assert [encounter.object for encounter in simulation.trajectory.encounters] == ["blue mug"]
    shown = [frame.index for frame in simulation.frames]
    assert simulation.trajectory.encounters[0].first_frame in shown, "people are shown the encounter"


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    result = cow(tmp_path, "demo", "--out", "file/below")
    assert result.returncode == 1
    assert result.stderr.splitlines()[0] == "folder-not-writable: The results cannot be written."
    assert "Cannot write to 'file/below': Not a directory. Choose another place with --out." in result.stderr


def test_a_choice_that_there_is_not_is_told_with_those_there_are(tmp_path: Path, picture: Path) -> None:
    result = cow(tmp_path, "simulate", str(picture), QUESTION, "--format", "jpg")
    assert result.returncode == 2
    assert "'jpg' is not one of 'gif', 'webp', 'sheet'." in result.stderr


def test_a_port_that_is_taken_is_told_before_anything_is_loaded(tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        result = cow(tmp_path, "serve", "--port", str(port))
    assert result.returncode == 2
    assert f"COW_PORT={port}: Address already in use" in result.stderr
    assert not (tmp_path / "data").exists()


def test_what_to_give_is_named_as_options(tmp_path: Path, picture: Path) -> None:
    result = cow(tmp_path, "answer", str(picture), "Will it hit anything?")
    assert "--point X,Y" in result.stdout.replace("\n", " ")
    assert "grounding.point" not in result.stdout


def test_json_and_overrides(tmp_path: Path, picture: Path) -> None:
    result = cow(
        tmp_path, "simulate", str(picture), "?", "--point", "150,200", "--object", "it", "--direction", "0,-1",
        "--speed", "50", "--no-video", "--max-side", "0", "--frames", "initial", "--count", "1", "--json",
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    simulation = Simulation.model_validate_json(result.stdout)
    assert simulation.grounding.object == "it"
    assert simulation.motion.speed == 50
    assert simulation.video is None
    assert [(f.index, f.width) for f in simulation.frames] == [(1, 640)]
    assert (tmp_path / "toys-cow" / "frame_001.png").is_file()


def test_other_objects_a_law_and_no_ensemble(tmp_path: Path, picture: Path) -> None:
    other = ["--other", "blue cube=430,160,510,250", "--other", "spot=470,200"]
    told = cow(tmp_path, "simulate", str(picture), QUESTION, *other[:2], "--law", "ballistic", "--ensemble", "0",
               "--no-video", "--num-frames", "5", "--json")  # fmt: skip
    simulation = Simulation.model_validate_json(told.stdout)
    assert simulation.motion.law == "ballistic"
    assert [(one.object, one.bbox) for one in simulation.grounding.others] == [("blue cube", (430, 160, 510, 250))]
    twice = cow(tmp_path, "simulate", str(picture), QUESTION, *other)
    assert "`objects.1` lies in the same box as `objects.0`" in twice.stderr
    wrong = cow(tmp_path, "simulate", str(picture), QUESTION, "--other", "430,160")
    assert "--other takes NAME=X0,Y0,X1,Y1" in wrong.stderr


def test_what_is_taken_away_and_how_far_it_goes(tmp_path: Path, picture: Path) -> None:
    other = ["--other", "blue cube=430,160,510,250"]
    told = cow(tmp_path, "simulate", str(picture), QUESTION, *other, "--remove", "blue cube", "--distance", "60",
               "--ensemble", "0", "--no-video", "--json")  # fmt: skip
    simulation = Simulation.model_validate_json(told.stdout)
    assert [(each.kind, each.object.object) for each in simulation.grounding.interventions] == [("remove", "blue cube")]
    assert simulation.trajectory.factual is not None
    assert simulation.motion.distance == 60
    wrong = cow(tmp_path, "simulate", str(picture), QUESTION, "--place", "the ball near the box")
    assert "--place takes an object, a relation (into, onto," in wrong.stderr


def test_a_box_and_a_fall(tmp_path: Path, picture: Path) -> None:
    result = cow(
        tmp_path, "simulate", str(picture), "?", "--box", "105,155,195,245", "--kind", "fall", "--json", "--no-video"
    )
    assert result.returncode == 0, result.stderr
    assert Simulation.model_validate_json(result.stdout).motion.kind == "fall"


@pytest.mark.parametrize(
    ("arguments", "code", "told"),
    [
        (
            ["If the pink car moves left, what?"],
            1,
            "cannot-ground: An object in the question could not be found in the image, or does not allow what the",
        ),
        (["If the red ball moves forward, what?"], 1, "Use --direction DX,DY (x right, y down)."),
        ([QUESTION, "--point", "1;2"], 1, "--point takes 2 numbers separated by commas"),
        ([QUESTION, "--box", "1,2,3"], 1, "--box takes 4 numbers"),
        ([QUESTION, "--direction", "left"], 1, "such as -1,0 for to the left (x right, y down); got 'left'."),
        (
            [QUESTION, "--until", "never"],
            2,
            "'never' is not one of 'contact'. Choose one of these, or leave the option",
        ),
        (
            [QUESTION, "--request", '{"foo": 1}'],
            1,
            "foo: there is no such field, got 1. --request takes these fields: ",
        ),
        ([QUESTION, "--request", "r.json"], 1, "Give an object: "),
        ([""], 1, 'question: is empty, got "". Ask, for example: \'If the red ball moves'),
        ([QUESTION, "--distance", "-5"], 1, "motion.distance: Input should be greater than 0, got -5"),
        ([QUESTION, "--kind", "projectile"], 1, "needs a `direction`"),
        ([QUESTION, "--object", "x"], 1, "needs --point, --box or --trajectory"),
        ([QUESTION, "--depth-scale", "0.001"], 1, "--depth-scale needs --depth"),
        ([QUESTION, "--generator", "dream"], 1, "There is no generator 'dream'. There are: ati, cutout,"),
        ([QUESTION, "--option", "steps"], 1, "--option takes NAME=VALUE"),
        ([QUESTION, "--option", "steps=4"], 1, "/generator_options/steps"),
        ([QUESTION, "--num-frames", "1"], 1, "num_frames"),
        ([QUESTION, "--frames", "best"], 2, "'best'"),
        ([], 2, "QUESTION"),
    ],
)
def test_errors_are_told_in_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, picture: Path, arguments: list[str], code: int, told: str
) -> None:
    monkeypatch.chdir(tmp_path)
    environment = {"COW_DATA_DIR": str(tmp_path / "data"), "NO_COLOR": "1", "TERM": "dumb"}
    result = CliRunner().invoke(app, ["simulate", str(picture), *arguments], env=environment)
    assert result.exit_code == code
    assert isinstance(result.exception, SystemExit)
    assert told in " ".join(result.stderr.split())
    assert "Traceback" not in result.stderr


def test_files_that_are_missing_or_no_images(tmp_path: Path) -> None:
    assert cow(tmp_path, "simulate", "nowhere.png", QUESTION).returncode == 2
    (tmp_path / "text.png").write_text("hello")
    result = cow(tmp_path, "simulate", "text.png", QUESTION)
    assert result.returncode == 1
    assert "image-type-unsupported" in result.stderr


def test_bad_settings_are_named(tmp_path: Path) -> None:
    result = cow(tmp_path, "models", COW_MAX_IMAGE_MEGAPIXELS="many", COW_PORT="99999")
    assert result.returncode == 2
    assert "COW_MAX_IMAGE_MEGAPIXELS='many'" in result.stderr
    assert "COW_PORT='99999'" in result.stderr
    assert "Traceback" not in result.stderr


def test_a_misspelled_setting_is_named_with_the_one_that_may_be_meant(tmp_path: Path) -> None:
    result = cow(tmp_path, "serve", COW_APIKEYS="{}", COW_BASE_URL="http://127.0.0.1:1", COW_API_KEY="key")
    assert result.returncode == 2
    assert "COW_APIKEYS is no setting; COW_API_KEYS is." in result.stderr


def test_models_and_doctor(tmp_path: Path) -> None:
    assert "cutout (default)" in cow(tmp_path, "models").stdout
    models = Models.model_validate_json(cow(tmp_path, "models", "--json").stdout)
    assert "cutout" in [m.name for m in models.generators]
    result = cow(tmp_path, "doctor")
    assert result.returncode == 0, result.stdout + result.stderr
    assert "Everything that a default request needs is ready." in result.stdout
    report = json.loads(cow(tmp_path, "doctor", "--json").stdout)
    assert report["cow"] == __version__
    assert report["packages"]["fastapi"]
    assert report["problem"] is None


def test_the_doctor_finds_what_is_wrong(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    result = cow(tmp_path, "doctor", COW_DATA_DIR=str(tmp_path / "file"))
    assert result.returncode == 1
    assert "storage-unavailable" in result.stdout
    result = cow(tmp_path, "serve", COW_DATA_DIR=str(tmp_path / "file"))
    assert result.returncode == 1
    assert "storage-unavailable" in result.stderr


def test_a_default_backend_that_is_not_there_stops_the_start(tmp_path: Path) -> None:
    result = cow(tmp_path, "serve", COW_GENERATOR="dream")
    assert result.returncode == 2
    assert "COW_GENERATOR='dream': known are ati, cutout" in result.stderr


def test_a_folder_that_cannot_be_written_is_told_before_the_work(tmp_path: Path, picture: Path) -> None:
    (tmp_path / "file").write_text("")
    result = cow(tmp_path, "simulate", str(picture), QUESTION, "--out", "file")
    assert result.returncode == 1
    assert "--out" in result.stderr
    assert "grounding" not in result.stdout


def test_version_and_help(tmp_path: Path) -> None:
    assert cow_from_nothing(tmp_path, "--version").stdout.strip() == f"cow {__version__}"
    shown = cow_from_nothing(tmp_path, "--help").stdout
    assert set(COMMANDS) <= set(re.findall(r"^(\w[\w ]+):$", shown, re.M))
    listed = re.findall(r"^  (\w+) ", shown.partition("Ask:")[2], re.M)
    assert sorted(listed) == sorted(name for name, each in commands().items() if not each.hidden)


def commands() -> dict[str, typer.core.TyperCommand]:
    return vars(typer.main.get_command(app))["commands"]


def test_a_failure_is_json_where_json_is_wanted(tmp_path: Path) -> None:
    refused = cow(tmp_path, "simulate", str(Path(__file__)), "If it moves, what happens?", "--json")
    assert refused.returncode == 1
    assert json.loads(refused.stdout)["type"] == "urn:cow:problem:image-type-unsupported"
    assert refused.stderr.startswith("image-type-unsupported: ")


def test_a_setting_that_is_not_json_is_named(tmp_path: Path) -> None:
    result = cow(tmp_path, "models", COW_CHECKPOINTS="nonsense")
    assert result.returncode == 2
    assert "COW_CHECKPOINTS is not JSON" in result.stderr
    assert "Traceback" not in result.stderr


def test_a_depth_map_is_a_file(tmp_path: Path, picture: Path) -> None:
    (tmp_path / "depth.png").write_bytes(depth_png(TrueCamera().depth([(110, 160, 190, 240), (430, 160, 510, 250)])))
    given = ("--depth", "depth.png", "--depth-scale", "0.001", "--num-frames", "9", "--out", "out")
    result = cow(tmp_path, "simulate", str(picture), QUESTION, *given)
    assert result.returncode == 0, result.stderr
    told = Simulation.model_validate_json((tmp_path / "out" / "simulation.json").read_text()).trajectory
    assert told.camera is not None
    assert (told.camera.source, round(told.camera.height, 1)) == ("depth", 1.5)


def test_options_have_the_defaults_of_the_fields() -> None:
    sent = request_body()
    default = SimulateRequest(image="data:", question="?").model_dump(mode="json")
    for name in ("ensemble", "num_frames", "fps", "seed", "reader", "generator"):
        assert sent[name] == default[name]
    for name in ("count", "max_side"):
        assert sent["frames"][name] == default["frames"][name]
    for path in FIELDS.values():
        record, _, field = path.partition("/")
        assert field in SimulateRequest.model_json_schema()["$defs"][f"{record.capitalize()}Request"]["properties"]
