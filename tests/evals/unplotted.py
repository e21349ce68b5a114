"""Imported by the process that `cow eval` is forked from: a report has plots, which take seconds, if PLOTS is set."""

import os
from collections.abc import Sequence
from pathlib import Path

from cow_service.evals.report import write
from cow_service.evals.report.summary import Findings

drawn = write.write_plots


def write_plots(folder: Path, findings: Findings) -> Sequence[Path]:
    return drawn(folder, findings) if os.environ.get("PLOTS") else ()


write.write_plots = write_plots
