"""The wheel, built and installed where nothing of the checkout is: prompts and manifests must be inside."""

from __future__ import annotations

import re
import subprocess
import sys
import tarfile
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest
from conftest import ROOT, new_environment
from drawn import ball, floor, png_bytes

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]


@pytest.mark.soak
def test_the_wheel_runs_in_a_clean_environment(wheel: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert "cow_service/_shipped/prompts/motion-sentence.md" in names
    assert "cow_service/_shipped/models/cutout.yaml" in names
    assert "cow_service/py.typed" in names
    assert "cow_service/web/docs/start.js" in names
    assert "cow_service/evals/report/figures.mplstyle" in names
    assert not [name for name in names if name.startswith(("tests", "examples", "benchmarks"))]
    binaries = new_environment(tmp_path / "venv", wheel)
    (tmp_path / "a.png").write_bytes(png_bytes(ball(floor(), (150, 200), 40, (210, 20, 20))))
    command = [binaries / "cow", "simulate", "a.png", "If the red ball moves left, what happens?", "--out", "out"]
    environment = {"COW_DATA_DIR": str(tmp_path / "data"), "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    assert (tmp_path / "out" / "video.mp4").stat().st_size > 1000
    for arguments in (["--generator", "tiny-ati"], ["--generator", "ati"]):
        again = [*command, *arguments]
        refused = subprocess.run(again, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert refused.returncode == 1
        assert "needs torch, diffusers" in refused.stderr
        assert 'pip install "cow-service[wan]"' in refused.stderr
    listed = subprocess.run([binaries / "cow", "models"], env=environment, capture_output=True, text=True, check=True)
    assert "tiny-ati" in listed.stdout


def test_an_index_can_show_the_description(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        metadata = message_from_bytes(archive.read(name))
        names = archive.namelist()
    text = metadata.get_payload()
    assert isinstance(text, str)
    assert text.lstrip().startswith("# COW")
    assert all(target.startswith("http") for target in re.findall(r"]\(([^)]*)\)", text))
    assert metadata["License-Expression"] == "Apache-2.0"
    for licence in metadata.get_all("License-File", []):
        assert any(name.endswith(f".dist-info/licenses/{licence}") for name in names)


def test_the_source_distribution_has_what_it_takes_to_run_and_no_tests(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "build", "--sdist", "--no-isolation", "--outdir", str(tmp_path), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    (built,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(built) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"Makefile", "LICENSE", "README.md", "hatch_build.py", "docker/locks/cpu.txt"} <= names
    assert {"examples/photographs/coffee.jpg", "docs/http.md", "prompts/locate.md", "models/cutout.yaml"} <= names
    assert not [name for name in names if name.startswith(("tests/", "benchmarks/", "cow-scenes/", ".ci/"))]
