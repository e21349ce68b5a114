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
from cow_service.jobs.inspection import unserved_jobs
from cow_service.jobs.overview import remedy, told
from cow_service.records import BackendInfo, Unserved
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
    unserved: list[Unserved]  # jobs that wait, and that no process takes
    jobs_problem: str | None  # why the job database could not be read

    @property
    def healthy(self) -> bool:
        """Whether the default request can be served, and every queued job is taken."""
        return self.problem is None and self.jobs_problem is None and not self.unserved


def examine(service: Service) -> Report:
    """Inspects this installation and its job database. Imports no model library, and writes only an empty file, which
    it removes."""
    problem = None
    try:
        service.check()
    except CowError as error:
        problem = f"{error.code}: {error.detail}"
    models = service.models()
    unserved, jobs_problem = _unserved(service)
    return Report(
        cow=__version__,
        python=platform.python_version(),
        platform=f"{sys.platform} {platform.machine()}",
        packages={name: _installed(name) for name in PACKAGES},
        data_folder=str(service.settings.data_dir),
        free_disk_gb=_free_disk(service),
        problem=problem,
        backends=[*models.readers, *models.generators],
        unserved=list(unserved),
        jobs_problem=jobs_problem,
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
    if report.jobs_problem:
        console.print(f"[red]{escape(report.jobs_problem)}[/]", highlight=False, soft_wrap=True)
    for one in report.unserved:
        console.print(f"[yellow]{escape(f'{told(one)} {remedy(one)}')}[/]", highlight=False, soft_wrap=True)


def _unserved(service: Service) -> tuple[tuple[Unserved, ...], str | None]:
    """Jobs that no process takes, or why that is not known."""
    try:
        return unserved_jobs(service.settings), None
    except CowError as error:
        return (), f"{error.code}: {error.detail}"


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
