"""The tables of a report, with the paper's figures next to ours, as Markdown, CSV and LaTeX."""

import csv
import io
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from cow_service.evals.asking import DIFFERENCES as READING
from cow_service.evals.design import BASELINE
from cow_service.evals.items import TASKS, Task
from cow_service.evals.report.summary import ArmSummary, Contrast, Findings
from cow_service.evals.runs import EvalRun
from cow_service.evals.statistics import Cost, Gain, Rates, Spread

_LATEX = str.maketrans(
    {character: f"\\{character}" for character in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$"}
)
SOURCE = "CausalSpatial, arXiv 2601.13304"
# Of all questions, in percent.
PRINTED_TPR = {"GPT-5": 54.17, "Gemini 2.5 Pro": 50.55, "Qwen3-VL-30B-T": 50.50, "human": 84.49}
# Of COW with Qwen3-VL-30B-A3B-I over the same model without, in points.
PRINTED_GAINS: dict[Task, float] = {"collision": 2.40, "trajectory": 2.20}
PRINTED_MODEL = "Qwen3-VL-30B-A3B-I with COW"
PROTOCOL = (
    "Options are shown in a random order, another one in every repeat and the same in every arm, unless --order data "
    "or --preset paper asks for the data's own order, in which the public scripts show them.",
    "Simulated frames are those around the moment that matters, unless an arm has :initial: the paper shows frames "
    "1, 3 and 5.",
    "The paper asked five times without COW and three times with it; here all arms are asked equally often.",
    "The note about frames is worded anew; the question and the JSON template are the paper's.",
    "An answer counts for the option whose text was shown with its letter.",
    "Questions whose call failed count nowhere and are listed; the public scripts score the text of the error.",
    "Intervals and tests are paired by question and clustered by scene; the paper prints means over repeats.",
)
DATA = (
    "The paper's cells do not all follow from the published data (n = 1030; some of its cells have fewer questions, "
    "and its abstain rates fit 958): figures are shown side by side and are not tuned to agree.",
    "The option that abstains is found by its text, not by the column `not_sure`.",
    "Items are identified by subset, shard and row: ids are not unique.",
)
DIFFERENCES = {"Protocol": PROTOCOL, "Reading replies": READING, "Data": DATA}  # from the paper, by what they are about
ALL = "all"
NONE = ""  # a cell without a value
_GAIN: dict[str, Callable[[Gain], str]] = {
    "questions": lambda gain: str(gain.questions),
    "scenes": lambda gain: str(gain.scenes),
    "gain, points": lambda gain: f"{100 * gain.gain:+.2f}",
    "95% interval": lambda gain: f"{100 * gain.low:+.2f} to {100 * gain.high:+.2f}" if gain.scenes > 1 else "one scene",
    "helped": lambda gain: str(gain.helped),
    "hurt": lambda gain: str(gain.hurt),
}


@dataclass(frozen=True)
class Table:
    """A title, the names of columns, and rows of text. The first column is to the left, the others to the right."""

    name: str  # of its files
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def tables(findings: Findings, *, published: bool = False) -> tuple[Table, ...]:
    """All tables that have rows; for the published data with the paper's figures."""
    arms = findings.arms
    found = (
        *(primary(findings), by_level(arms, published), overview(arms), contrasts(findings, published=published)),
        *(splits(findings), calibration(arms), costs(arms)),
    )
    return tuple(table for table in found if table.rows)


def primary(findings: Findings) -> Table:
    """The primary question of each run, and whether it was fixed before."""
    rows: list[tuple[str, ...]] = []
    for each in findings.primaries:
        gain = each.found.gain
        told = f"{100 * gain.gain:+.2f}", f"{100 * gain.low:+.2f} to {100 * gain.high:+.2f}", p_text(each.found.p)
        planned = "no plan" if each.departures is None else "; ".join(each.departures) or "as planned"
        explored = f" (explored besides: {', '.join(each.explored)})" if each.explored else ""
        counts = str(gain.questions), str(gain.scenes)
        rows.append((each.name, ", ".join(each.placebos), each.found.placebo, *counts, *told, planned + explored))
    header = ("arm", "placebos", "strongest", "questions", "scenes", "gain, points", "95% interval", "p", "plan")
    title = "Primary question: simulated frames must beat each placebo; the gain is that over the strongest"
    return Table("primary", title, header, tuple(rows))


def by_level(summaries: Sequence[ArmSummary], published: bool) -> Table:
    """As the paper prints it: right and abstained by task and level; of its data with its own figures below."""
    keys = {key for each in summaries for key in each.cells}
    levels = Counter(task for task, level in keys if level is not None)
    keys = {(task, level) for task, level in keys if level is None or levels[task] > 1}
    columns = sorted(keys, key=lambda key: (TASKS.index(key[0]), key[1] is None, key[1] or ""))
    rows: list[tuple[str, ...]] = []
    for each in summaries:
        measured = [*(each.cells.get(key) for key in columns), each.rates]
        for measure, name in (("TPR", "tpr"), ("NSR", "nsr")):
            rows.append((each.name, measure, *(_spread(getattr(rates, name, None)) for rates in measured)))
    blank = (NONE,) * len(columns)
    if published:
        rows += [(f"{name} (paper)", "TPR", *blank, f"{value:.2f}") for name, value in PRINTED_TPR.items()]
    header = ("arm", "%", *(f"{task} {level or ALL}" for task, level in columns), ALL)
    title = f"Right (TPR) and abstained (NSR) of all questions, mean ± SD over repeats, %; paper: {SOURCE}"
    return Table("levels", title, header, tuple(rows))


def overview(summaries: Sequence[ArmSummary]) -> Table:
    """The rates of each arm."""
    columns: dict[str, Callable[[Rates], str]] = {
        "questions": lambda rates: str(rates.questions),
        "replies": lambda rates: str(rates.replies),
        "failed": lambda rates: str(rates.failed),
        "TPR, %": lambda rates: _spread(rates.tpr),
        "NSR, %": lambda rates: _spread(rates.nsr),
        "TPR by paper's reading, %": lambda rates: _spread(rates.tpr_as_paper),
        "unreadable": lambda rates: str(rates.unreadable),
        "shown": lambda rates: f"{rates.imagined:.1%}",
        "refused": lambda rates: f"{rates.refused:.1%}",
    }
    rows = tuple((each.name, *(cell(each.rates) for cell in columns.values())) for each in summaries)
    return Table("arms", "Replies by arm", ("arm", *columns), rows)


def contrasts(findings: Findings, *, by_task: bool = True, published: bool = False) -> Table:
    """The gain of each arm over those it is compared with; for the published data also the paper's figures."""
    rows = [
        (each.name, each.reference, each.task or ALL, *(cell(each.gain) for cell in _GAIN.values()), *_p(each))
        for each in findings.contrasts
        if by_task or each.task is None
    ]
    if rows and by_task and published:
        printed = ((f"{PRINTED_MODEL} (paper)", task, f"{value:+.2f}") for task, value in PRINTED_GAINS.items())
        rows += [(name, "without", task, NONE, NONE, value, *(NONE,) * 5) for name, task, value in printed]
    title = (
        "Gains, paired by question and repeat, clustered by scene; Holm p is adjusted over all rows, those that a plan "
        "does not have by themselves; over an arm that always abstains there is no p, and no gain of imagination"
    )
    return Table("gains", title, ("arm", "over", "task", *_GAIN, "p", "Holm p"), tuple(rows))


def _p(each: Contrast) -> tuple[str, str]:
    """p, alone and adjusted; none where the reference always abstains, which is no gain of imagination."""
    if each.abstains:
        return "abstains", NONE
    return p_text(each.gain.p), p_text(each.gain.p_holm) + (" (explored)" if each.is_exploratory else "")


def splits(findings: Findings) -> Table:
    """Why simulated frames help or hurt: the gain by known properties of each question's simulation."""
    rows = tuple((each.name, each.by, each.value, *(c(each.gain) for c in _GAIN.values())) for each in findings.splits)
    title = f"Gains over `{BASELINE}` by properties of the simulation; explored after the fact, so without p"
    return Table("why", title, ("arm", "questions grouped by", "value", *_GAIN), rows)


def calibration(summaries: Sequence[ArmSummary]) -> Table:
    """How good the predicted probabilities of the simulations are."""
    known = [(each.name, found) for each in summaries if (found := each.calibration) is not None]
    rows = tuple((name, str(found.count), f"{found.brier:.3f}", f"{found.base_brier:.3f}") for name, found in known)
    header = ("arm", "questions", "Brier score", "of the base rate")
    return Table("calibration", "Predicted probabilities of the event in question", header, rows)


def costs(summaries: Sequence[ArmSummary]) -> Table:
    """What a reply costs, as if each were asked alone."""
    columns: dict[str, Callable[[Cost], str]] = {
        "calls": lambda cost: _two_digits(cost.calls / cost.replies),
        "input tokens": lambda cost: _two_digits(cost.input_tokens / cost.replies),
        "output tokens": lambda cost: _two_digits(cost.output_tokens / cost.replies),
        "seconds": lambda cost: f"{cost.seconds / cost.replies:.2f}",
        "simulations": lambda cost: _two_digits(cost.imaginations / cost.replies),
        "money in all": lambda cost: NONE if cost.money is None else f"{cost.money:.2f}",
    }
    rows = tuple((each.name, *(cell(each.cost) for cell in columns.values())) for each in summaries)
    title = "Cost of a reply as measured, simulations included; stages that were cached take little (means)"
    return Table("cost", title, ("arm", *columns), rows)


def replies(runs: Sequence[EvalRun]) -> Table:
    """Every reply, a row each; for further analysis."""
    header = ("mllm", "arm", "repeat", "item", "task", "level", "scene", "truth", "chosen", "right", "read as paper")
    header += ("frames", "refusal", "probability", "path error", "calls", "input tokens", "output tokens", "seconds")
    rows: list[tuple[str, ...]] = []
    for run in runs:
        for each in (each for each in run.observations if each.failure is None):
            question = each.item, each.task, each.level, each.scene
            chosen = each.truth, each.read or NONE, str(int(each.right))
            seen = each.read_as_paper, len(each.frames), each.refusal, each.probability, each.path_error
            spent = each.calls, each.input_tokens, each.output_tokens, f"{each.seconds:.3f}"
            others = (NONE if value is None else str(value) for value in (*seen, *spent))
            rows.append((run.info.mllm, each.arm, str(each.repeat), *question, *chosen, *others))
    return Table("replies", "Every reply", header, tuple(rows))


def _spread(spread: Spread | None) -> str:
    if spread is None:
        return NONE
    return f"{100 * spread.mean:.2f}" + ("" if spread.sd is None else f" ± {100 * spread.sd:.2f}")


def p_text(value: float | None) -> str:
    """A p value; empty for none."""
    if value is None:
        return NONE
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def points(share: float) -> str:
    """A difference of shares, in percentage points, with its sign."""
    return f"{100 * share:+.1f}".replace("-", "−").replace("+0.0", "0.0").replace("−0.0", "0.0")


def _two_digits(mean: float) -> str:
    return "0" if mean == 0 else f"{mean:.{max(0, 2 - max(0, math.floor(math.log10(mean))))}f}"


def markdown(table: Table) -> str:
    """With pipes; cells are padded, so that it can be read as it stands."""
    lines = [[" ".join(cell.replace("|", "\\|").split()) for cell in row] for row in (table.header, *table.rows)]
    first, *others = (max(map(len, column)) for column in zip(*lines, strict=True))
    lines.insert(1, [":" + "-" * (first - 1), *("-" * (width - 1) + ":" for width in others)])
    padded = (
        [row[0].ljust(first), *(cell.rjust(width) for cell, width in zip(row[1:], others, strict=True))]
        for row in lines
    )
    return "\n".join(f"| {' | '.join(row)} |" for row in padded)


def csv_text(table: Table) -> str:
    """As a spreadsheet reads it."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([table.header, *table.rows])
    return text.getvalue()


def latex(table: Table) -> str:
    """A `table` with the rules of the package booktabs."""
    header, *body = (" & ".join(cell.translate(_LATEX) for cell in row) + r" \\" for row in (table.header, *table.rows))
    title, columns = table.title.translate(_LATEX), "l" + "r" * (len(table.header) - 1)
    lines = (
        r"\begin{table}", r"\centering", rf"\caption{{{title}}}", rf"\begin{{tabular}}{{{columns}}}",
        r"\toprule", header, r"\midrule", *body, r"\bottomrule", r"\end{tabular}", r"\end{table}", "",
    )  # fmt: skip
    return "\n".join(lines)
