"""The tables of a report."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

from cow_service.evals.items import TASKS
from cow_service.evals.report.paper import PRINTED_GAINS, PRINTED_MODEL, PRINTED_TPR, SOURCE
from cow_service.evals.report.summary import ArmSummary
from cow_service.evals.report.tables import Table
from cow_service.evals.runs import Run
from cow_service.evals.statistics import Gain, Rates, Spread

ALL = "all"
NONE = ""  # a cell of which nothing is known
_IN_SHORT = ("arm", "replies", "failed", "TPR, %", "NSR, %", "unreadable", "imagined", "refused")
_GAINS_IN_SHORT = ("arm", "task", "questions", "gain, points", "95% interval", "helped", "hurt", "McNemar p")


def tables(summaries: Sequence[ArmSummary]) -> tuple[Table, ...]:
    """All tables that have rows."""
    found = (by_level(summaries), overview(summaries), gains(summaries), calibration(summaries), costs(summaries))
    return tuple(table for table in found if table.rows)


def by_level(summaries: Sequence[ArmSummary]) -> Table:
    """As the paper prints it: right and abstained by task and level, with the paper's own figures below."""
    keys = {(cell.task, cell.level) for each in summaries for cell in each.cells}
    levels = Counter(task for task, level in keys if level is not None)
    keys = {(task, level) for task, level in keys if level is None or levels[task] > 1}
    columns = sorted(keys, key=lambda key: (TASKS.index(key[0]), key[1] is None, key[1] or ""))
    rows: list[tuple[str, ...]] = []
    for each in summaries:
        cells = {(cell.task, cell.level): cell.rates for cell in each.cells}
        for measure in ("TPR", "NSR"):
            shown = [_measure(cells[key], measure) if key in cells else NONE for key in columns]
            rows.append((each.name, measure, *shown, _measure(each.rates, measure)))
    blank = (NONE,) * len(columns)
    rows += [(f"{name} (paper)", "TPR", *blank, f"{value:.2f}") for name, value in PRINTED_TPR.items()]
    header = ("arm", "%", *(f"{task} {level or ALL}" for task, level in columns), ALL)
    title = f"Right (TPR) and abstained (NSR) of all questions, mean ± SD over repeats, %; paper: {SOURCE}"
    return Table("levels", title, header, tuple(rows))


def overview(summaries: Sequence[ArmSummary]) -> Table:
    """What each arm came to."""
    header = ("arm", "questions", "replies", "failed", "TPR, %", "NSR, %", "TPR by paper's reading, %", "unreadable")
    rows = [
        (
            each.name,
            str(each.rates.questions),
            str(each.rates.replies),
            str(each.rates.failed),
            _spread(each.rates.tpr),
            _spread(each.rates.nsr),
            _spread(each.rates.tpr_as_paper),
            str(each.rates.unreadable),
            f"{each.rates.imagined:.1%}",
            f"{each.rates.refused:.1%}",
        )
        for each in summaries
    ]
    return Table("arms", "Replies by arm", (*header, "imagined", "refused"), tuple(rows))


def gains(summaries: Sequence[ArmSummary]) -> Table:
    """What each arm gains over `never`, and where the paper printed a gain, that."""
    header = (
        "arm",
        "task",
        "questions",
        "scenes",
        "gain, points",
        "95% interval",
        "helped",
        "hurt",
        "McNemar p",
        "Holm p",
    )
    rows: list[tuple[str, ...]] = []
    for each in summaries:
        if each.gain is not None:
            rows.append((each.name, ALL, *_gain(each.gain)))
            rows += [(each.name, one.task, *_gain(one.gain)) for one in each.gains]
    if rows:
        rows += [
            (f"{PRINTED_MODEL} (paper)", task, NONE, NONE, f"{value:+.2f}", *(NONE,) * 5)
            for task, value in PRINTED_GAINS.items()
        ]
    return Table(
        "gains", "Gain over the arm `never`, paired by question and repeat, drawn by scene", header, tuple(rows)
    )


def in_short(summaries: Sequence[ArmSummary]) -> Table:
    """What each arm came to, for a terminal."""
    whole = overview(summaries)
    kept = tuple(whole.header.index(name) for name in _IN_SHORT)
    rows = tuple(tuple(row[place] for place in kept) for row in whole.rows)
    return Table("arms-in-short", whole.title, _IN_SHORT, rows)


def gains_in_short(summaries: Sequence[ArmSummary]) -> Table:
    """The gains over all tasks, and those on each, for a terminal."""
    whole = gains(summaries)
    kept = tuple(whole.header.index(name) for name in _GAINS_IN_SHORT)
    rows = tuple(tuple(row[place] for place in kept) for row in whole.rows if row[-1] or row[1] == ALL)
    return Table("gains-in-short", whole.title, _GAINS_IN_SHORT, rows)


def calibration(summaries: Sequence[ArmSummary]) -> Table:
    """How good the probabilities are that the simulations told."""
    rows = [
        (each.name, str(known.count), f"{known.brier:.3f}", f"{known.base_brier:.3f}")
        for each in summaries
        if (known := each.calibration) is not None
    ]
    header = ("arm", "questions", "Brier score", "of the base rate")
    return Table("calibration", "Told probabilities of what is asked", header, tuple(rows))


def costs(summaries: Sequence[ArmSummary]) -> Table:
    """What a reply costs, as if each were asked alone."""
    header = ("arm", "calls", "input tokens", "output tokens", "seconds", "simulations", "money in all")
    rows = [
        (
            each.name,
            *(
                _of_each(value, each.cost.replies)
                for value in (each.cost.calls, each.cost.input_tokens, each.cost.output_tokens)
            ),
            f"{each.cost.seconds / each.cost.replies:.2f}",
            _of_each(each.cost.imaginations, each.cost.replies),
            NONE if each.cost.money is None else f"{each.cost.money:.2f}",
        )
        for each in summaries
    ]
    return Table(
        "cost", "Cost of a reply, simulations included, as if each were asked alone (means)", header, tuple(rows)
    )


def pairs(runs: Sequence[Run], summaries: Sequence[ArmSummary]) -> Table:
    """Every question and repeat, with what each arm chose; for further analysis."""
    chosen = {
        (run, each.arm, of.info.data_digest, each.item, each.repeat): each
        for run, of in enumerate(runs)
        for each in of.observations
    }
    places = {(of.info.data_digest, each.item, each.repeat): each for of in runs for each in of.observations}
    rows: list[tuple[str, ...]] = []
    for (data, item, repeat), each in sorted(places.items(), key=lambda place: place[0]):
        found = [chosen.get((one.run, one.arm, data, item, repeat)) for one in summaries]
        told = [(NONE, NONE) if one is None else (one.read or NONE, str(int(one.right))) for one in found]
        told = [
            (NONE, NONE) if one is not None and one.failure is not None else shown
            for one, shown in zip(found, told, strict=True)
        ]
        rows.append(
            (
                data[:12],
                item,
                each.task,
                each.level,
                each.scene,
                str(repeat),
                each.truth,
                *(t for two in told for t in two),
            )
        )
    columns = tuple(f"{each.name}: {what}" for each in summaries for what in ("chosen", "right"))
    header = ("data", "item", "task", "level", "scene", "repeat", "truth", *columns)
    return Table("pairs", "Every question and repeat", header, tuple(rows))


def _measure(rates: Rates, measure: str) -> str:
    return _spread(rates.tpr if measure == "TPR" else rates.nsr)


def _spread(spread: Spread) -> str:
    return f"{100 * spread.mean:.2f}" + ("" if spread.sd is None else f" ± {100 * spread.sd:.2f}")


def _gain(gain: Gain) -> tuple[str, ...]:
    return (
        str(gain.questions),
        str(gain.scenes),
        f"{100 * gain.gain:+.2f}",
        f"{100 * gain.low:+.2f} to {100 * gain.high:+.2f}",
        str(gain.helped),
        str(gain.hurt),
        _p(gain.p),
        NONE if gain.p_holm is None else _p(gain.p_holm),
    )


def _p(value: float) -> str:
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def _of_each(total: float, count: int) -> str:
    mean = total / count
    return "0" if mean == 0 else f"{mean:.{max(0, 2 - max(0, math.floor(math.log10(mean))))}f}"
