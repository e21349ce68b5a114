"""`cow doctor`: the installed packages, whether each backend is ready, and the command that installs what it lacks."""

from __future__ import annotations

import platform
import shutil
import sys
from importlib.metadata import PackageNotFoundError, version

from pydantic import BaseModel
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cow_service import __version__
from cow_service.errors import CowError
from cow_service.records import BackendInfo
from cow_service.service import Service

PACKAGES = (
    "fastapi",
    "uvicorn",
    "pydantic",
    "numpy",
    "opencv-python-headless",
    "pillow",
    "av",
    "torch",
    "diffusers",
    "transformers",
    "pydantic-ai-slim",
    "llguidance",
)


class Report(BaseModel):
    """What `cow doctor` found."""

    cow: str
    python: str
    platform: str
    packages: dict[str, str | None]
    data_folder: str
    free_disk_gb: float | None
    problem: str | None
    backends: list[BackendInfo]

    @property
    def healthy(self) -> bool:
        """Whether the default request can be served."""
        return self.problem is None


def examine(service: Service) -> Report:
    """Inspects this installation. Imports no heavy package, and writes only an empty file, which it removes."""
    problem = None
    try:
        service.check()
    except CowError as error:
        problem = f"{error.code}: {error.detail}"
    models = service.models()
    return Report(
        cow=__version__,
        python=platform.python_version(),
        platform=f"{sys.platform} {platform.machine()}",
        packages={name: _installed(name) for name in PACKAGES},
        data_folder=str(service.settings.data_dir),
        free_disk_gb=_free_disk(service),
        problem=problem,
        backends=[*models.readers, *models.generators],
    )


def print_report(report: Report, *, as_json: bool) -> None:
    """The report as a table, or as JSON."""
    if as_json:
        print(report.model_dump_json(indent=2))
        return
    console = Console()
    console.print(f"cow {report.cow}, Python {report.python}, {report.platform}", highlight=False)
    free = "" if report.free_disk_gb is None else f" ({report.free_disk_gb:.1f} GB free)"
    console.print(f"data folder: {report.data_folder}{free}", highlight=False, soft_wrap=True)
    table = Table("backend", "ready", "missing", "get it with", box=None, pad_edge=False)
    for backend in report.backends:
        ready = {True: "[green]yes[/]", False: "[yellow]no[/]", None: "unknown"}[backend.ready]
        table.add_row(
            backend.name, ready, ", ".join(backend.missing) or "-", escape(backend.install or backend.pull or "-")
        )
    console.print(table)
    installed = ", ".join(f"{name} {found}" for name, found in report.packages.items() if found)
    absent = ", ".join(name for name, found in report.packages.items() if not found)
    console.print(f"installed: {installed}", highlight=False)
    if absent:
        console.print(f"not installed (needed by no backend that is ready): {absent}", highlight=False)
    if report.problem:
        console.print(f"[red]{report.problem}[/]", highlight=False)
    else:
        console.print("[green]The default request can be served.[/]")


def _installed(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _free_disk(service: Service) -> float | None:
    folder = service.settings.data_dir
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return round(shutil.disk_usage(folder).free / 1e9, 1)
