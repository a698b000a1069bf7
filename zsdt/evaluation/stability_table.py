"""Figures of the stability table: how large a normal error is, when an error passed three times that, what flag came.

Normal of a party and a kind of body is the 95th percentile of its error over all frames of the cases marked normal.
Which row is worse: failed before silent before late before all others, then by the largest error over the normal one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from zsdt.evaluation.stability_row import Outcome, Row

PASSED = 3.0  # times the normal error
ENOUGH = 95.0  # percentile
CURVES = ("error", "hidden")
COLUMNS = (
    "case", "what", "party", "verdict", "reason", "frames", "worst_x_normal", "first_3x_frame", "first_flag_frame",
    "flags", "energy_growth", "entropy_min", "worst_error", "note", "seconds",
)  # fmt: skip


@dataclass(frozen=True)
class Judged:
    """A row with its figures: worst (of place and hidden field, over the normal one; NaN where unknown), first frame
    beyond 3x the normal error and first frame with a flag (None: never), and the verdict.

    verdict: failed and rejected as the outcome; bounded: the error stays below 3x the normal one, or no truth is known;
    flagged: it does not, and a flag came before or in that frame; late: a flag came after it; silent: none came.
    """

    row: Row
    worst: float
    first_3x: int | None
    first_flag: int | None
    verdict: str


def normal_errors(rows: Sequence[Row], normal: Sequence[str]) -> dict[tuple[str, str, str], float]:
    """(kind of case, party, error or hidden) -> normal error, from the rows of the cases named `normal`."""
    found: dict[tuple[str, str, str], list[float]] = {}
    for row in rows:
        if row.case in normal:
            for name in CURVES:
                known = [e for e in getattr(row, name) if math.isfinite(e)]
                found.setdefault((row.kind, row.party, name), []).extend(known)
    return {key: float(np.percentile(errors, ENOUGH)) for key, errors in found.items() if errors}


def judge(rows: Sequence[Row], normal: Sequence[str]) -> list[Judged]:
    """Every row with its figures, in the order given."""
    usual = normal_errors(rows, normal)
    return [_judge(row, usual) for row in rows]


def _judge(row: Row, usual: dict[tuple[str, str, str], float]) -> Judged:
    ratio = np.full(max(len(row.error), len(row.hidden)), np.nan)
    for name in CURVES:
        normal = usual.get((row.kind, row.party, name), 0.0)
        if normal > 0 and getattr(row, name):
            curve = np.asarray(getattr(row, name), float)
            ratio[: len(curve)] = np.fmax(ratio[: len(curve)], curve / normal)
    known = ratio[np.isfinite(ratio)]
    beyond = np.flatnonzero(np.nan_to_num(ratio, nan=0.0) > PASSED)
    first_3x = int(beyond[0]) if len(beyond) else None
    flagged = [k for k, flag in enumerate(row.flags or []) if flag]
    first_flag = flagged[0] if flagged else None
    verdict = str(row.outcome)
    if row.outcome == Outcome.bounded and first_3x is not None:
        verdict = "silent" if first_flag is None else "flagged" if first_flag <= first_3x else "late"
    return Judged(row, float(known.max()) if len(known) else math.nan, first_3x, first_flag, verdict)


ORDER = ("failed", "silent", "late", "flagged", "rejected", "bounded")


def worst_first(judged: Sequence[Judged]) -> list[Judged]:
    """The order of the table."""
    return sorted(judged, key=lambda j: (ORDER.index(j.verdict), -np.nan_to_num(j.worst, nan=-1.0)))


def cells(judged: Judged, what: Mapping[str, str]) -> dict[str, Any]:
    """A line of the CSV file; what: case -> words."""
    row = judged.row
    known = [e for e in row.error if math.isfinite(e)]
    at = judged.first_flag
    return {
        "case": row.case,
        "what": what.get(row.case, ""),
        "party": row.party,
        "verdict": judged.verdict,
        "reason": row.reason,
        "frames": row.frames,
        "worst_x_normal": judged.worst,
        "first_3x_frame": judged.first_3x,
        "first_flag_frame": at,
        "flags": "" if at is None or row.flags is None else row.flags[at],
        "energy_growth": row.energy_growth,
        "entropy_min": row.entropy_min,
        "worst_error": max(known) if known else math.nan,
        "note": row.note,
        "seconds": row.seconds,
    }


def counts(judged: Sequence[Judged]) -> dict[str, dict[str, int]]:
    """Party -> verdict -> how many rows."""
    found: dict[str, dict[str, int]] = {}
    for j in judged:
        of = found.setdefault(j.row.party, {name: 0 for name in ORDER})
        of[j.verdict] += 1
    return found
