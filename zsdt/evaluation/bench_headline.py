"""The short table of the benchmark for a front page: one row a method, the worst methods shown like the best."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from zsdt.evaluation.bench import in_scenes
from zsdt.evaluation.bench_words import cell, known, table, three

Rows = Sequence[Mapping[str, Any]]
HEAD = ["clips", "method", "displacement %", "velocity %", "stress or energy %", "ms per frame"]


def headline_table(points: Rows) -> str:
    """Markdown: for every scene and regime each trained or simulated method once, on its fastest backend, best first.

    Of the variants of a method the one with the smallest displacement error stands for it; other resolutions than those
    that jobs judged are left out. Errors are RRMSE in percent, mean (worst).
    """
    lines = []
    for (scene, regime), mine in in_scenes([row for row in points if row["trained"] and row["resolution"] == 1.0]):
        best: dict[str, Mapping[str, Any]] = {}
        for row in sorted(mine, key=_order):
            best.setdefault(str(row["method"]), row)
        for row in best.values():
            third = "stress_rrmse" if known(row.get("stress_rrmse")) else "energy_increment_rrmse"
            errors = [cell(row, name) for name in ("displacement_rrmse", "velocity_rrmse", third)]
            backend = "" if row["backend"] in ("", None) else f" ({row['backend']})"
            lines.append([f"{scene}, {regime}", f"{row['method']}{backend}", *errors, three(row["ms_p50"])])
    return table(HEAD, lines)


def _order(row: Mapping[str, Any]) -> tuple[float, float]:
    return float(row["displacement_rrmse"]), float(row["ms_p50"])
