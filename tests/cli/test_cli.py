"""The command line: what its options mean, what it prints and writes, how it fails. `cow batch`: `test_batch.py`."""

from __future__ import annotations

import json
import re
import socket
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import typer
from click.testing import Result
from command_line import cow_from_nothing, settings_in
from drawn import ball, block, floor, png_bytes
from floors import TrueCamera, depth_png
from job_rows import open_database
from PIL import Image
from refusals import refused
from sdk import SIMULATION
from servers import Program
from typer.testing import CliRunner
from waiting import TIME_LIMIT, eventually

from cow_service import __version__
from cow_service.cli.main import app
from cow_service.cli.options import COMMANDS, WRITTEN, printable, request_reader
from cow_service.records import Answer, Models, Simulation
from cow_service.requests.flat import FLAT, FlatField, flat_fields

QUESTION = "If the red ball moves to the right, will it hit the blue cube?"
QUICK = ("--num-frames", "9", "--ensemble", "0", "--no-video")


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    path = tmp_path / "toys.png"
    path.write_bytes(
        png_bytes(block(ball(floor(), (150, 200), 40, (210, 20, 20)), (430, 160, 510, 250), (50, 80, 200)))
    )
    return path


@pytest.fixture
def cow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs a command in this process, in a folder of its own."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str | Path, **environment: str) -> Result:
        result = CliRunner().invoke(app, [*map(str, arguments)], env=settings_in(tmp_path, **environment))
        assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
        return result

    return run


# Simulations


@pytest.mark.slow
def test_simulate_writes_frames_video_overlay_and_record(cow: Any, tmp_path: Path, picture: Path) -> None:
    length = ("--num-frames", "41", "--frames", "uniform", "--count", "3", "--ensemble", "0")
    other = ("--other", "blue cube=430,160,510,250", "--law", "ballistic", "--out", "out")
    formats = ("--format", "gif", "--format", "webp", "--format", "sheet")
    result = cow("simulate", picture, QUESTION, *length, *other, *formats)
    assert result.exit_code == 0, result.stderr
    out = tmp_path / "out"
    names = {"frame_000.png", "frame_020.png", "frame_040.png", "overlay.jpg", "simulation.json", "video.mp4"}
    made = {"clip.gif", "clip.webp", "sheet.png"}
    assert {path.name for path in out.iterdir()} == names | made
    assert all(name in result.stdout for name in (*names, *made))
    simulation = Simulation.model_validate_json((out / "simulation.json").read_text())
    assert (simulation.grounding.object, simulation.motion.law) == ("red ball", "ballistic")
    assert [(one.object, one.bbox) for one in simulation.grounding.others] == [("blue cube", (430, 160, 510, 250))]
    with Image.open(out / "frame_020.png") as frame:
        assert frame.size == (512, 320)
    for told in ("grounding", "red ball at (150, 200)", "linear (+1.00, +0.00)", "hits blue cube", "41-frame video"):
        assert told in result.stdout
    assert not result.stderr


@pytest.mark.slow
def test_json_is_all_that_is_printed_and_no_old_frame_stays(cow: Any, tmp_path: Path, picture: Path) -> None:
    (tmp_path / "depth.png").write_bytes(depth_png(TrueCamera().depth([(110, 160, 190, 240), (430, 160, 510, 250)])))
    depth = ("--depth", "depth.png", "--depth-scale", "0.001", "--frames", "uniform", "--max-side", "0")
    for count, frames in (("5", [0, 2, 4, 6, 8]), ("2", [0, 8])):
        result = cow("simulate", picture, QUESTION, *QUICK, *depth, "--count", count, "--json")
        assert result.exit_code == 0, result.stderr
        simulation = Simulation.model_validate_json(result.stdout)
        assert simulation.video is None
        assert [(frame.index, frame.width) for frame in simulation.frames] == [(index, 640) for index in frames]
        (tmp_path / "toys-cow" / "notes.txt").touch()
    camera = simulation.trajectory.camera
    assert camera is not None
    assert (camera.source, round(camera.height, 1)) == ("depth", 1.5)
    names = {"frame_000.png", "frame_008.png", "overlay.jpg", "simulation.json"}
    assert {path.name for path in (tmp_path / "toys-cow").iterdir()} == names | {"notes.txt"}


def test_no_result_of_another_picture_is_written_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from cow_service.cli.console import default_folder

    monkeypatch.chdir(tmp_path)
    image = tmp_path / "toys.png"
    image.write_bytes(b"x")
    assert default_folder(image) == Path("toys-cow")
    for folder in ("toys-cow", "toys-cow-2"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "simulation.json").write_text(json.dumps(SIMULATION))
    assert default_folder(image) == Path("toys-cow-3")
    (tmp_path / "toys-cow-2" / "simulation.json").write_text("damaged")
    assert default_folder(image) == Path("toys-cow-2")


@pytest.mark.slow
def test_the_demo_needs_nothing(cow: Any, tmp_path: Path) -> None:
    result = cow("demo")
    assert result.exit_code == 0, result.stderr
    simulation = Simulation.model_validate_json((tmp_path / "cow-demo" / "simulation.json").read_text())
    assert [encounter.object for encounter in simulation.trajectory.encounters] == ["blue mug"]
    shown = [frame.index for frame in simulation.frames]
    assert simulation.trajectory.encounters[0].first_frame in shown, "people are shown the encounter"


@pytest.mark.slow
def test_an_answer_is_printed_with_what_it_rests_on(cow: Any, picture: Path) -> None:
    given = ("--point", "150,200", "--direction", "1,0", "--choice", "Yes", "--choice", "No", *QUICK[:4])
    result = cow("answer", picture, QUESTION, *given, "--votes", "3", "--baseline", "--no-imagine")
    assert result.exit_code == 0, result.stderr
    rows = dict(re.findall(r"^(\w[\w ]+?) {2,}(.+?) *$", result.stdout, re.M))
    assert {"answer", "votes", "without frames", "tokens", "time", "reader"} <= rows.keys()
    result = cow("answer", picture, "Will it hit anything?")
    assert "--point X,Y" in result.stdout.replace("\n", " "), "what to give is named as options"
    assert "grounding.point" not in result.stdout


@pytest.mark.slow
def test_the_folder_of_an_answer(cow: Any, tmp_path: Path, picture: Path) -> None:
    """`cow answer --out` leaves the simulation's files and answer.json; with --json and no folder, nothing."""
    folder = tmp_path / "out"
    cow("answer", picture, QUESTION, "--choice", "No", "--choice", "Yes", "--out", folder)
    assert Answer.model_validate_json((folder / "answer.json").read_text()).answer == "B"
    assert (folder / "overlay.jpg").exists()
    told = Answer.model_validate_json(cow("answer", picture, QUESTION, "--no-imagine", "--votes", "2", "--json").stdout)
    assert (told.simulation, told.not_sure, told.votes) == (None, True, {"not sure": 2})


# Options


def test_options_become_fields_of_a_request(tmp_path: Path) -> None:
    path = tmp_path / "path.json"
    path.write_text('{"points": [[1, 2], [3, 4]]}')
    depth = tmp_path / "depth.png"
    depth.write_bytes(b"png")
    moving = {"box": "105, 155,195,245", "object": "it", "direction": "0,-1", "kind": "projectile", "speed": "50"}
    scene = {"other": ["blue cube=1,2,3,4", "a=b=5,6"], "remove": ["mug"], "depth": depth, "depth_scale": 0.001}
    place = ["apple in front of the bowl", "cube BETWEEN mug and vase"]
    own = {"option": ["steps=4", "mode=fast"], "request": '{"camera": {"pitch": 25}, "depth": {"focal": 240}}'}
    read = request_reader("answer")
    body = read(**moving, **scene, **own, place=place, max_side=0, until="contact", distance="60", choice=["a", "b"])
    assert body == {
        "grounding": {"bbox": [105, 155, 195, 245], "object": "it"},
        "motion": {"direction": [0, -1], "kind": "projectile", "speed": 50, "distance": 60, "until": "contact"},
        "objects": [{"object": "blue cube", "bbox": [1, 2, 3, 4]}, {"object": "a=b", "point": [5, 6]}],
        "interventions": [
            {"kind": "remove", "object": "mug"},
            {"kind": "place", "object": "apple", "relation": "in-front-of", "targets": ["the bowl"]},
            {"kind": "place", "object": "cube", "relation": "between", "targets": ["mug", "vase"]},
        ],
        "depth": {"map": "data:image/png;base64,cG5n", "scale": 0.001, "focal": 240},
        "camera": {"pitch": 25},
        "frames": {"max_side": None},
        "generator_options": {"steps": 4, "mode": "fast"},
        "options": ["a", "b"],
    }
    named = read(object="it", trajectory=path)
    assert named["grounding"] == {"object": "it", "point": [1, 2]}
    assert named["trajectory"] == {"points": [[1, 2], [3, 4]]}


def test_options_are_fields_of_the_request() -> None:
    """With their defaults and descriptions; what differs from the default is sent."""
    names = {field.option for fields in FLAT.values() for field in fields}
    assert WRITTEN.keys() < names | {"request"}
    for kind, command in (("simulate", commands()["simulate"]), ("answer", commands()["answer"])):
        own = {param.name: param for param in command.get_params(typer.Context(command))}
        for field, schema in flat_fields(kind).items():
            if field.option and field.option not in WRITTEN:
                shown = own[field.option]
                assert (shown.default, shown.help) == (schema.get("default"), schema["description"])
        assert request_reader(kind)(**{name: param.default for name, param in own.items() if name in names}) == {}
    read = request_reader("simulate")
    assert read(object="it", point="1,2", law="contact", request='{"grounding": {"size": 0.1}, "motion": null}') == {
        "grounding": {"object": "it", "point": [1, 2], "size": 0.1},
        "motion": None,
    }


def test_a_field_of_several_forms_is_written_as_json_or_text(monkeypatch: pytest.MonkeyPatch) -> None:
    length = FlatField("motion/distance", "distance", "distance")
    forms = {"anyOf": [{"type": "number"}, {"type": "object"}]}
    monkeypatch.setattr("cow_service.requests.flat.flat_fields", lambda _: {length: forms})
    for text, value in (("5", 5), ('{"value": 2, "unit": "m"}', {"value": 2, "unit": "m"}), ("2 m", "2 m")):
        assert request_reader("simulate")(distance=text) == {"motion": {"distance": value}}


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"point": "1;2"}, "--point takes X,Y, numbers separated by commas"),
        ({"box": "1,2,3"}, "--box takes X0,Y0,X1,Y1"),
        ({"direction": "left"}, "--direction takes DX,DY"),
        ({"other": ["430,160"]}, "--other takes NAME=X0,Y0,X1,Y1"),
        ({"place": ["the ball near the box"]}, "--place takes an object"),
        ({"object": "x"}, "--object needs --point, --box or --trajectory"),
        ({"depth_scale": 0.001}, "--depth-scale needs --depth"),
        ({"option": ["steps"]}, "--option takes NAME=VALUE"),
        ({"request": "r.json"}, "--request is not JSON"),
        ({"request": "[]"}, "--request must be an object, got list"),
    ],
)
def test_an_option_that_cannot_be_read_is_named(options: dict[str, Any], says: str) -> None:
    with refused("invalid-request") as caught:
        request_reader("simulate")(**options)
    assert says in caught.value.detail


# Failures


@pytest.mark.parametrize(
    ("arguments", "code", "told"),
    [
        (["If the pink car moves left, what?"], 1, "cannot-ground: "),
        (["If the red ball moves forward, what?"], 1, "Use --direction DX,DY (x right, y down)."),
        ([QUESTION, "--until", "never"], 2, "'never' is not one of 'contact', 'out-of-view'. Choose one of these"),
        ([QUESTION, "--format", "gif", "--no-video"], 1, "--no-video"),
        ([QUESTION, "--request", '{"foo": 1}'], 1, "--request takes these fields: "),
        ([QUESTION, "--distance", "-5"], 1, "motion.distance: "),
        ([QUESTION, "--out", "file/below"], 1, "folder-not-writable: "),
    ],
)
def test_errors_are_told_in_words(
    cow: Any, tmp_path: Path, picture: Path, arguments: list[str], code: int, told: str
) -> None:
    (tmp_path / "file").touch()
    result = cow("simulate", picture, *arguments)
    assert result.exit_code == code
    assert told in " ".join(result.stderr.split())
    assert "grounding " not in result.stdout, "nothing was begun"
    assert not (tmp_path / "toys-cow" / "overlay.jpg").exists()


def test_a_failure_is_json_where_json_is_wanted(cow: Any) -> None:
    assert cow("simulate", "nowhere.png", QUESTION).exit_code == 2
    refused = cow("simulate", Path(__file__), "If it moves, what happens?", "--json")
    assert refused.exit_code == 1
    assert json.loads(refused.stdout)["type"] == "urn:cow:problem:image-type-unsupported"
    assert refused.stderr.startswith("image-type-unsupported: ")


def test_nothing_that_controls_a_terminal_is_printed() -> None:
    assert printable("a\x1b[2J\u202eb\n") == "a\ufffd[2J\ufffdb\n"


def test_bad_settings_are_named(cow: Any) -> None:
    for settings, says in (
        ({"COW_RATE_LIMIT": "many", "COW_PORT": "99999"}, ("COW_RATE_LIMIT='many'", "COW_PORT='99999'")),
        ({"COW_CHECKPOINTS": "nonsense"}, ("COW_CHECKPOINTS is not JSON",)),
        ({"COW_API_KEYS": "alice:sha256:00"}, ("COW_API_KEYS is not JSON", '{"alice": "sha256:', "cow keys new")),
        ({"COW_ADMIN_KEYS": "light"}, ("COW_ADMIN_KEYS is not JSON", '["one", "another"]')),
        ({"COW_APIKEYS": "{}", "COW_API_KEY": "key"}, ("COW_APIKEYS is no setting; COW_API_KEYS is.",)),
    ):
        result = cow("models", **settings)
        assert result.exit_code == 2
        assert all(each in result.stderr for each in says)


@pytest.mark.slow
def test_what_a_server_cannot_start_with_is_told_before_anything_is_loaded(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = str(other.getsockname()[1])
        result = cow_from_nothing(tmp_path, "serve", "--port", port)
    assert result.returncode == 2
    assert f"COW_PORT={port}: " in result.stderr
    assert not (tmp_path / "data").exists()
    result = cow_from_nothing(tmp_path, "serve", "--port", "0", COW_GENERATOR="dream")
    assert result.returncode == 2
    assert "COW_GENERATOR='dream': known are " in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("command", ["serve", "worker"])
def test_sigterm_ends_every_role_with_0_also_while_the_database_is_away(tmp_path: Path, command: str) -> None:
    away = {"COW_DATABASE_URL": "postgresql://cow@127.0.0.1:1/cow", "COW_PORT": "0", "COW_CONCURRENCY": "1"}
    program = Program(tmp_path, ["-m", "cow_service.cli.main", command], "log", **away)
    program.launch()
    try:
        assert program.process is not None
        eventually(lambda: "The job database cannot be reached" in program.log())
        program.process.terminate()
        assert program.process.wait(TIME_LIMIT) == 0, program.log()
    finally:
        program.end()


@pytest.mark.slow
@pytest.mark.parametrize("store", ["a bucket that is not there", "another one than that of its database"])
def test_a_server_without_its_store_of_artifacts_says_why_it_does_not_start(tmp_path: Path, store: str) -> None:
    from object_store import serving

    with serving() as objects, closing(open_database(tmp_path / "data")) as database:
        database.claim("folder-1")
        bucket = "s3://no-such-bucket" if "bucket" in store else objects.url
        own = {"COW_ARTIFACTS": bucket, "COW_WORKERS": "false", **objects.environment}
        told = cow_from_nothing(tmp_path, "serve", "--port", "0", **own)
    if "bucket" in store:
        assert told.returncode == 1
        assert told.stderr.count("storage-unavailable: ") == 1
    else:
        assert told.returncode == 2
    assert ("no such bucket" if "bucket" in store else "folder-1") in told.stderr
    assert "Traceback" not in told.stderr


# What there is


def test_models_and_doctor(cow: Any, tmp_path: Path) -> None:
    assert "cutout (default)" in cow("models").stdout
    models = Models.model_validate_json(cow("models", "--json").stdout)
    assert "cutout" in [m.name for m in models.generators]
    assert cow("models", "--json", "pull", "ati").exit_code == 2, "--json goes after the command"
    result = cow("doctor")
    assert result.exit_code == 0, result.stdout + result.stderr
    assert "Everything that a default request needs is ready." in result.stdout
    report = json.loads(cow("doctor", "--json").stdout)
    assert (report["cow"], report["problem"]) == (__version__, None)
    assert report["packages"]["fastapi"]
    assert report["free_disk_gb"] > 0
    (tmp_path / "file").write_text("")
    result = cow("doctor", COW_DATA_DIR=str(tmp_path / "file"))
    assert result.exit_code == 1
    assert "storage-unavailable" in result.stdout


def test_tracks_are_those_of_a_whole_simulation(cow: Any, tmp_path: Path) -> None:
    file = tmp_path / "simulation.json"
    trajectory = SIMULATION["trajectory"]
    for text, says in (
        (json.dumps(SIMULATION | {"trajectory": {**trajectory, "states": [], "tracks": []}}), "minimal"),
        ("{}", "simulation.json is not a simulation"),
    ):
        file.write_text(text)
        found = cow("tracks", file, "--out", "tracks.npz")
        assert found.exit_code == 1
        assert says in found.stderr


def commands() -> dict[str, typer.core.TyperCommand]:
    return vars(typer.main.get_command(app))["commands"]


def test_version_and_help(cow: Any) -> None:
    assert cow("--version").stdout.strip() == f"cow {__version__}"
    shown = cow("--help").stdout
    assert set(COMMANDS) <= set(re.findall(r"^(\w[\w ]+):$", shown, re.M))
    listed = re.findall(r"^  (\w+) ", shown.partition("Ask:")[2], re.M)
    assert sorted(listed) == sorted(name for name, each in commands().items() if not each.hidden)
    titles = re.findall(r"^(\w[\w ]+):$", cow("simulate", "--help").stdout, re.M)
    assert titles == ["Arguments", "Options", *[*FLAT][1:-1]]
