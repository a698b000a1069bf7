"""The stability table as CSV, as a page with its worst rows first, and as a picture of cases by parties."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from zsdt.evaluation.stability_row import Party
from zsdt.evaluation.stability_table import COLUMNS, ENOUGH, ORDER, PASSED, Judged, cells, counts, worst_first
from zsdt.evaluation.tables import write_csv
from zsdt.files import atomic_path

# Okabe and Ito: verdicts stay apart for any kind of colour vision; each cell has its words, too.
COLOURS = {
    "bounded": "#9fd8c4",
    "rejected": "#bcbcbc",
    "flagged": "#f3dc7a",
    "late": "#e69f00",
    "silent": "#d55e00",
    "failed": "#8b0000",
}
WORDS = {
    "bounded": f"bounded, error below {PASSED:g} x normal",
    "rejected": "rejected with a reason",
    "flagged": f"beyond {PASSED:g} x, flagged in time",
    "late": f"beyond {PASSED:g} x, flagged later",
    "silent": f"beyond {PASSED:g} x, no flag",
    "failed": "failed: not finite, out of range, hang or crash",
}
SHOWN = 12  # worst rows on top of the page
EXPLAINED = (
    f"`silent`, `late`: the error passed {PASSED:g} times the normal one before any flag of the trust monitor came; "
    f"`flagged`: the flag came first. Normal is the {ENOUGH:g}th percentile of the error of the cases named "
    "normal_*, of the same party. Errors: of a beam the root mean square distance of its free nodes from the truth "
    "over its length, and the error of its stress over Young's modulus; of a liquid the distance of the centroids over "
    "its depth at rest. Energy growth: energy that is neither there at the start nor work of the ports (load, gravity, "
    "walls, corrections), over the largest turnover. Least entropy production: the smallest of any frame over all that "
    "was produced. The solver is the truth, so it has no error of its own."
)


def write_report(
    folder: Path, judged: Sequence[Judged], what: Mapping[str, str], origin: str, prefix: str = ""
) -> Path:
    """Writes stability.csv, stability.md and stability.png into `folder`; the page. prefix: of the names of files."""
    lines = [cells(j, what) for j in worst_first(judged)]
    write_csv(folder / f"{prefix}stability.csv", [{name: line[name] for name in COLUMNS} for line in lines])
    with atomic_path(folder / f"{prefix}stability.png") as beside:
        beside.write_bytes(picture(judged))
    page = folder / f"{prefix}stability.md"
    with atomic_path(page) as beside:
        beside.write_text(text(judged, what, origin, f"{prefix}stability"))
    return page


def text(judged: Sequence[Judged], what: Mapping[str, str], origin: str, name: str) -> str:
    """The page."""
    worst = [j for j in worst_first(judged) if j.verdict != "bounded"][:SHOWN]
    parts = [
        "# Hard cases",
        origin,
        EXPLAINED,
        count_table(judged),
        f"![Cases by parties]({name}.png)",
        "## The worst rows",
        table(worst, what),
        "## All rows",
        table(worst_first(judged), what),
    ]
    return "\n\n".join(parts) + "\n"


def count_table(judged: Sequence[Judged]) -> str:
    """How many rows of each verdict."""
    found = counts(judged)
    lines = ["| party | " + " | ".join(ORDER) + " |", "|---|" + "---:|" * len(ORDER)]
    lines += [f"| {party} | " + " | ".join(str(of[v]) for v in ORDER) + " |" for party, of in found.items()]
    return "\n".join(lines)


HEADS = (
    "case", "party", "verdict", "error x normal", f"first frame beyond {PASSED:g} x", "first flag", "energy growth %",
    "least entropy production %", "frames", "reason or note",
)  # fmt: skip


def table(judged: Sequence[Judged], what: Mapping[str, str]) -> str:
    """Rows for people."""
    lines = ["| " + " | ".join(HEADS) + " |", "|---|---|---|" + "---:|" * 6 + "---|"]
    for j in judged:
        line = cells(j, what)
        first = "-" if j.first_3x is None else str(j.first_3x)
        flag = "-" if j.first_flag is None else f"{j.first_flag}: {line['flags']}"
        words = " ".join(w for w in (_short(j.row.reason), j.row.note) if w)
        row = [
            f"{j.row.case}: {what.get(j.row.case, '')}", j.row.party, j.verdict, _three(j.worst), first, flag,
            _three(100 * j.row.energy_growth), _three(100 * j.row.entropy_min), str(j.row.frames), words,
        ]  # fmt: skip
        lines.append("| " + " | ".join(row) + " |")
    return "\n".join(lines)


def _short(reason: str, most: int = 110) -> str:
    return reason if len(reason) <= most else f"{reason[: most - 3]}..."


def _three(value: float) -> str:
    if not math.isfinite(value):
        return "-"
    return "0" if abs(value) < 1e-9 else f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}"


def picture(judged: Sequence[Judged]) -> bytes:
    """Cases by parties, coloured by verdict, with the largest error over the normal one in each cell."""
    groups = list(dict.fromkeys(j.row.kind for j in judged))
    parties = [p.value for p in Party if any(j.row.party == p for j in judged)]
    names = {g: list(dict.fromkeys(j.row.case for j in judged if j.row.kind == g)) for g in groups}
    tallest = max(len(n) for n in names.values())
    figure = Figure(figsize=(1.2 + 3.9 * len(groups), 1.6 + 0.27 * tallest), dpi=110, layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, len(groups), width_ratios=[3 if g != "camera" else 1.6 for g in groups]))
    for axis, group in zip(axes, groups, strict=True):
        here = [p for p in parties if any(j.row.kind == group and j.row.party == p for j in judged)]
        for j in (j for j in judged if j.row.kind == group):
            x, y = here.index(j.row.party), names[group].index(j.row.case)
            axis.fill_between([x - 0.48, x + 0.48], y - 0.46, y + 0.46, color=COLOURS[j.verdict], lw=0)
            axis.text(x, y, _cell(j), ha="center", va="center", fontsize=7, color="w" if j.verdict == "failed" else "k")
        axis.set(xlim=(-0.5, len(here) - 0.5), ylim=(tallest - 0.5, -0.5), title=group)
        axis.set_xticks(range(len(here)), here)
        axis.set_yticks(range(len(names[group])), names[group], fontsize=8)
        axis.tick_params(length=0)
        axis.xaxis.tick_top()
        for spine in axis.spines.values():
            spine.set_visible(False)
    handles = [Patch(color=COLOURS[v], label=WORDS[v]) for v in reversed(ORDER)]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    figure.suptitle("Hard cases: largest error over the normal one", fontsize=11)
    out = io.BytesIO()
    figure.savefig(out)
    return out.getvalue()


def _cell(judged: Judged) -> str:
    if judged.verdict == "rejected":
        return judged.row.reason.partition(":")[0][:14]
    if judged.verdict == "failed":
        return judged.row.reason.partition(":")[0][:14] or "failed"
    return "ok" if not math.isfinite(judged.worst) else f"{_three(judged.worst)} x"
