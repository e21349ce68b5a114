"""The plots of a report, each as SVG for pages and as PNG for papers and mails."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cow_service.evals.report.summary import ArmSummary

PLOTS = ("gains", "rates", "calibration", "cost")
SUFFIXES = (".svg", ".png")
PNG_DPI = 150


def write_plots(folder: Path, summaries: Sequence[ArmSummary]) -> tuple[Path, ...]:
    """Writes the plots for which there is something to draw, and removes those of an earlier report.

    The files are `gains`, `rates`, `calibration` and `cost`, each as `.svg` and `.png`. The same summaries make the
    same bytes of SVG.
    """
    # A second of imports, which nobody but the writer of a report should wait for.
    import matplotlib  # noqa: PLC0415

    from cow_service.evals.report.plot_calibration import draw_calibration  # noqa: PLC0415
    from cow_service.evals.report.plot_cost import draw_cost  # noqa: PLC0415
    from cow_service.evals.report.plot_gains import draw_gains  # noqa: PLC0415
    from cow_service.evals.report.plot_looks import STYLE  # noqa: PLC0415
    from cow_service.evals.report.plot_rates import draw_rates  # noqa: PLC0415

    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    for name, draw in zip(PLOTS, (draw_gains, draw_rates, draw_calibration, draw_cost), strict=True):
        # A salt of its own for each plot: their ids must differ when they stand in one page.
        style: dict[Any, Any] = {**STYLE, "svg.hashsalt": f"cow-{name}"}
        with matplotlib.rc_context(style), warnings.catch_warnings():
            # Names of models may have letters that the font has not: the SVG keeps them as text.
            warnings.filterwarnings("ignore", message="Glyph .* missing from")
            figure = draw(summaries)
            for suffix in SUFFIXES:
                path = folder / f"{name}{suffix}"
                path.unlink(missing_ok=True)
                if figure is None:
                    continue
                kept_out = {"Date": None, "Creator": None} if suffix == ".svg" else {"Software": None}
                figure.savefig(path, dpi=PNG_DPI, bbox_inches="tight", pad_inches=0.12, metadata=kept_out)
                written.append(path)
    return tuple(written)
