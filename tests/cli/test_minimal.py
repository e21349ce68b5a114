"""`Prefer: return=minimal`: results without the long lists, while stored jobs keep the whole."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import httpx
import pytest
from servers import BODY
from typer.testing import CliRunner

from cow_service.cli.main import app as cli
from cow_service.records import Answer, Simulation

pytestmark = pytest.mark.slow
MINIMAL = {"Prefer": "return=minimal"}
LISTS = {"states", "scale", "rotation", "turns", "band", "futures", "tracks", "tracks_visible"}
REMOVES = "If the blue cube is removed and the red ball moves to the right, will it leave the image? (A) Yes (B) No"


def without_lists(trajectory: dict[str, Any]) -> dict[str, Any]:
    paths = [{name: value for name, value in path.items() if name not in LISTS} for path in trajectory["paths"]]
    factual = trajectory["factual"]
    trajectory = {name: value for name, value in trajectory.items() if name != "still_tracks"}
    return trajectory | {"paths": paths, "factual": None if factual is None else without_lists(factual)}


@pytest.mark.parametrize("question", [BODY["question"], REMOVES])
def test_the_lists_alone_are_left_out_and_the_job_keeps_them(http: httpx.Client, question: str) -> None:
    removed = {"interventions": [{"kind": "remove", "object": "blue cube"}]} if question == REMOVES else {}
    cube = {"object": "blue cube", "bbox": [170, 60, 205, 98]}
    body = BODY | {"question": question, "num_frames": 81, "objects": [cube]} | removed
    sent = http.post("/simulate", json=body, headers=MINIMAL)
    assert (sent.status_code, sent.headers["preference-applied"]) == (200, "return=minimal")
    told = sent.json()
    kept = http.get(f"/jobs/{told['id']}")
    whole = kept.json()["result"]
    assert whole["trajectory"]["paths"][0]["states"]
    assert (whole["trajectory"]["factual"] is not None) is bool(removed)
    assert told == whole | {"trajectory": without_lists(whole["trajectory"])}
    assert len(sent.content) < len(kept.content) / 3
    assert Simulation.model_validate(told).trajectory.num_frames == 81
    lean = http.get(f"/jobs/{told['id']}", headers={"Prefer": 'return="minimal", wait=1'})
    assert lean.headers["preference-applied"] == "return=minimal"
    assert lean.json() == kept.json() | {"result": told}


def test_answers_with_a_simulation_and_without_one(http: httpx.Client) -> None:
    for imagine in ("always", "never"):
        body = BODY | {"imagine": imagine}
        told = http.post("/answer", json=body, headers=MINIMAL).json()
        whole = http.get(f"/jobs/{told['id']}").json()["result"]
        expected = copy.deepcopy(whole)
        if imagine == "always":
            expected["simulation"]["trajectory"] = without_lists(whole["simulation"]["trajectory"])
        assert told == expected
        assert Answer.model_validate(told).question == BODY["question"]
        assert "preference-applied" not in http.post("/answer", json=body).headers


def test_a_job_without_a_result_and_a_preference_that_is_none(http: httpx.Client) -> None:
    failed = http.post("/simulate", json=BODY | {"grounding": {"point": [5, 5]}}, headers=MINIMAL)
    assert failed.status_code == 422
    job = http.get("/jobs", params={"status": "failed"}).json()["jobs"][0]
    assert http.get(f"/jobs/{job['id']}", headers=MINIMAL).json()["problem"]["status"] == 422
    assert "trajectory" in http.post("/simulate", json=BODY, headers={"Prefer": "return=representation"}).json()


def test_tracks_of_a_minimal_result_are_refused(http: httpx.Client, tmp_path: Path) -> None:
    file = tmp_path / "simulation.json"
    file.write_text(http.post("/simulate", json=BODY, headers=MINIMAL).text)
    found = CliRunner().invoke(cli, ["tracks", str(file), "--out", str(tmp_path / "tracks.npz")])
    assert found.exit_code == 1
    assert "invalid-request: " in found.stderr
    file.write_text("{}")
    found = CliRunner().invoke(cli, ["tracks", str(file), "--out", str(tmp_path / "tracks.npz")])
    assert found.exit_code == 1
    assert "simulation.json is not a simulation" in found.stderr
