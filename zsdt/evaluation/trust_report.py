"""Does the flag come before the error triples? One table of the hard cases, with the false alarms on normal runs.

The limits are fixed before (`trust_normal`); hard cases are only looked at here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from zsdt.evaluation import tables
from zsdt.evaluation.plots import SETTINGS, png_of
from zsdt.evaluation.stability_row import Row
from zsdt.evaluation.stability_table import Judged
from zsdt.evaluation.trust_normal import NormalRun
from zsdt.files import atomic_path
from zsdt.twin.trust_limits import KINDS, TrustLimits

FRAMES = (0, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000)  # ticks
RED, BLUE, GREY = "#d1495b", "#2e6f95", "#b8b8b8"
RANK = {"silent": 0, "late": 1, "same frame": 2, "before": 3, "flag alone": 4, "quiet": 5, "gone": 6}


@dataclass(frozen=True)
class Warned:
    """A hard case by one party. first_flag, first_3x: frames, None: never; lead: frames from flag to 3x; verdict:

    before, same frame, late, silent: of a flag against an error that passed 3x the normal one; flag alone: a flag, but
    the error stayed below; quiet: neither; gone: the run was rejected with a reason, which says more than a flag.
    """

    case: str
    party: str
    first_flag: int | None
    first_3x: int | None
    flags: str
    verdict: str

    @property
    def lead(self) -> int | None:
        """Frames from the flag to the error, negative where it came late."""
        return None if self.first_flag is None or self.first_3x is None else self.first_3x - self.first_flag


def warned(judged: Judged) -> Warned:
    """What the flags of a row of the stability table were worth."""
    row, flag, passed = judged.row, judged.first_flag, judged.first_3x
    if passed is None:
        verdict = "quiet" if flag is None else "flag alone"
        if row.outcome == "rejected":
            verdict = "gone"
    elif flag is None:
        verdict = "gone" if row.outcome == "rejected" else "silent"
    else:
        verdict = "before" if flag < passed else "same frame" if flag == passed else "late"
    words = "" if flag is None or row.flags is None else row.flags[flag]
    return Warned(row.case, str(row.party), flag, passed, words, verdict)


def normal_table(scene: str, runs: Sequence[NormalRun], limits: TrustLimits) -> list[dict[str, Any]]:
    """A line for every normal run: how many of its frames are flagged, and why."""
    rows = []
    for run in runs:
        alarms = run.alarms(limits)
        flagged = [k for k, text in enumerate(alarms) if text]
        known = run.milliseconds[np.isfinite(run.milliseconds)][5:]
        p50, p95 = np.percentile(known, [50, 95]) if len(known) else (math.nan, math.nan)
        rows.append(
            {
                "scene": scene,
                "run": run.name,
                "loop": run.loop,
                "calibrates": run.calibrates,
                "frames": len(alarms),
                "flagged_frames": len(flagged),
                "first_flag_frame": flagged[0] if flagged else None,
                "flags": " ".join(sorted({word for k in flagged for word in alarms[k].split()})),
                "trust_ms_p50": float(p50),
                "trust_ms_p95": float(p95),
            }
        )
    return rows


def normal_row(row: Row) -> dict[str, Any]:
    """The same line for a normal case of the stability table: it tests limits, and never made one."""
    flags = row.flags or []
    return {
        "scene": f"{row.kind}, stability",
        "run": row.case,
        "loop": str(row.party),
        "calibrates": False,
        "frames": len(flags),
        "flagged_frames": sum(map(bool, flags)),
        "flags": " ".join(sorted({word for text in flags for word in text.split()})),
        "trust_ms_p50": "",
        "trust_ms_p95": "",
    }


def limit_table(scene: str, limits: TrustLimits) -> list[dict[str, Any]]:
    """A line for every value: its flag, the training's range, those of normal runs, and the limits, of an engine alone
    and of a twin."""
    rows = []
    for name in KINDS:
        if name not in limits.limits:
            continue
        row: dict[str, Any] = {"scene": scene, "value": name, "flag": KINDS[name].flag.value}
        parts = {
            "training": limits.training,
            "normal_alone": limits.normal_alone,
            "normal_twin": limits.normal_twin,
            "limit_alone": limits.alone,
            "limit_twin": limits.limits,
        }
        for word, ranges in parts.items():
            low, high = ranges.get(name, (math.nan, math.nan))
            row |= {f"{word}_least": low, f"{word}_greatest": high}
        rows.append(row)
    return rows


def false_alarms(rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Per scene and loop: runs and frames that are flagged, of those that did not calibrate."""
    found = []
    for scene, loop in dict.fromkeys((str(r["scene"]), str(r["loop"])) for r in rows):
        mine = [r for r in rows if (r["scene"], r["loop"]) == (scene, loop)]
        for word, share in (("tests", "False"), ("calibrates", "True")):
            of = [r for r in mine if str(r["calibrates"]) == share]
            if not of:
                continue
            frames, flagged = sum(int(r["frames"]) for r in of), sum(int(r["flagged_frames"]) for r in of)
            runs = sum(int(r["flagged_frames"]) > 0 for r in of)
            why = " ".join(sorted({w for r in of for w in str(r["flags"]).split()}))
            share_text = f"{100 * flagged / max(frames, 1):.2g}"
            found.append([scene, loop, word, str(len(of)), str(frames), f"{runs}", f"{flagged}", share_text, why])
    return found


def write_report(
    folder: Path, cases: Sequence[Warned], normal: Sequence[Mapping[str, Any]], what: Mapping[str, str], origin: str
) -> Path:
    """Writes `trust.md`, `trust_cases.csv` and `trust.png`; returns the page."""
    folder.mkdir(parents=True, exist_ok=True)
    ordered = sorted(cases, key=lambda c: (RANK[c.verdict], c.party, c.case))
    tables.write_csv(
        folder / "trust_cases.csv",
        [{**vars(c), "lead_frames": c.lead, "what": what.get(c.case, "")} for c in ordered],
    )
    with atomic_path(folder / "trust.png") as beside:
        beside.write_bytes(picture(ordered))
    page = folder / "trust.md"
    with atomic_path(page) as beside:
        beside.write_text(page_text(ordered, normal, what, origin))
    return page


def page_text(
    cases: Sequence[Warned], normal: Sequence[Mapping[str, Any]], what: Mapping[str, str], origin: str
) -> str:
    """The page in Markdown."""
    parties = list(dict.fromkeys(c.party for c in cases))
    counted = [[p, *(str(sum(c.party == p and c.verdict == v for c in cases)) for v in RANK)] for p in parties]
    listed = [
        [c.case, what.get(c.case, ""), c.party, c.verdict, *map(_number, (c.first_flag, c.first_3x, c.lead)), c.flags]
        for c in cases
    ]
    head = ["scene", "loop", "runs that", "runs", "frames", "runs flagged", "frames flagged", "% of frames", "flags"]
    return "\n".join(
        [
            "# Trust at run time",
            "",
            origin,
            "",
            "Limits are the hull of the training data and of normal runs, widened (`trust.json` beside the weights;",
            "`trust_limits_*.csv` here). Half of the normal runs made them, the other half only counts false alarms;",
            "how wide the margins are was chosen with both halves in view, so the rates below flatter a little.",
            "Hard cases were never used for a limit: they are the rows of `make stability`, judged after the limits",
            "were fixed. A flag says that a frame is outside of what was trained on and tested; it does not say how",
            "wrong it is.",
            "",
            "Two choices of *what* is judged (not of a limit) were made after a first look at the hard cases, so these",
            "are not wholly unseen: the observer's doubt counts only after the first correction, and an engine alone",
            "has limits without the jumps that corrections make. Innovations of normal runs are not white (nearly all",
            "correlation from frame to frame), so their correlation is recorded but has no limit.",
            "",
            "## False alarms on normal runs",
            "",
            _table(head, false_alarms(normal)) if normal else "Not calibrated yet.",
            "",
            *_cost(normal),
            "## Hard cases: flag against the first frame beyond 3x the normal error",
            "",
            "before, same frame, late, silent: the error passed 3x and a flag came so; flag alone: a flag, but the",
            "error stayed below; quiet: neither; gone: rejected with a reason: no frame could mislead.",
            "",
            _table(["party", *RANK], counted),
            "",
            "![Flag and error of the hard cases whose error passed 3x](trust.png)",
            "",
            _table(["case", "what", "party", "verdict", "flag at", "3x at", "lead", "flags"], listed),
            "",
        ]
    )


def _cost(normal: Sequence[Mapping[str, Any]]) -> list[str]:
    """One line for each scene: how long judging a frame takes."""
    lines = []
    for scene in dict.fromkeys(str(r["scene"]) for r in normal):
        of = [r for r in normal if r["scene"] == scene and str(r["trust_ms_p50"]) not in ("", "nan")]
        if of:
            p50, p95 = (float(np.median([float(r[f"trust_ms_{p}"]) for r in of])) for p in ("p50", "p95"))
            lines.append(f"Judging a frame of {scene}: {p50:.3f} ms (95 % below {p95:.3f} ms, medians over the clips).")
    return [*lines, ""]


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _number(value: int | None) -> str:
    return "-" if value is None else str(value)


def picture(cases: Sequence[Warned]) -> bytes:
    """Every case whose error passed 3x as a line: blue the flag, red the error, grey from one to the other where the
    flag came first, red where it came late or not at all."""
    shown = [c for c in cases if c.first_3x is not None]
    with plt.rc_context(SETTINGS):
        figure, axes = plt.subplots(figsize=(8.0, 1.2 + 0.22 * max(len(shown), 3)))
        for row, c in enumerate(shown):
            late = c.verdict in ("silent", "late")
            start, end = c.first_flag, c.first_3x
            if start is not None and end is not None:
                axes.plot([start, end], [row, row], color=RED if late else GREY, linewidth=2.5, zorder=1)
            if end is not None:
                axes.plot(end, row, "o", color=RED, markersize=5, zorder=3)
            if start is not None:
                axes.plot(start, row, "|", color=BLUE, markersize=10, markeredgewidth=2.5, zorder=2)
        axes.set_xscale("symlog", linthresh=10)
        last = max((max(c.first_3x or 0, c.first_flag or 0) for c in shown), default=1)
        ticks = [t for t in FRAMES if t <= 1.3 * last]
        axes.set_xticks(ticks, [str(t) for t in ticks])
        axes.minorticks_off()
        axes.set_xlim(-0.5, 1.3 * last)
        axes.set_yticks(np.arange(len(shown)), [f"{c.case}, {c.party}" for c in shown], fontsize=7)
        axes.set_ylim(len(shown) - 0.4, -0.6)
        axes.set_xlabel("frame")
        axes.plot([], [], "|", color=BLUE, markersize=10, markeredgewidth=2.5, label="first flag")
        axes.plot([], [], "o", color=RED, markersize=5, label="error beyond 3x normal")
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False, fontsize=8)
        figure.tight_layout()
        content = png_of(figure)
        plt.close(figure)
    return content
