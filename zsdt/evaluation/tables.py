"""Tables of an evaluation: CSV for machines, Markdown for people, JSON for the next stage."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from zsdt.evaluation.metrics import mean_and_worst
from zsdt.files import atomic_path

GROUP = ("method", "split", "regime")
# What is averaged over the trajectories of a group; each gives `<name>_mean` and `<name>_worst`.
AVERAGED = (
    "position_rrmse",
    "displacement_rrmse",
    "velocity_rrmse",
    "stress_rrmse",
    "von_mises_rrmse",
    "axial_stress_rrmse",
    "position_rmse",
    "displacement_rmse",
    "velocity_rmse",
    "stress_rmse",
    "von_mises_rmse",
    "axial_stress_rmse",
    "frequency_error",
    "error_growth",
    "ledger_residual",
    "elastic_account_rrmse",
    "dissipated_account_rrmse",
    "work_of_ports_account_rrmse",
)


def summarise(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row per method, split and regime: trajectories, mean and worst of every error, counts of divergence,
    milliseconds per frame (medians over the trajectories of their median and 95th percentile), mean node count.
    """
    groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(str(row[k]) for k in GROUP), []).append(row)
    return [_summary_row(key, members) for key, members in groups.items()]


def _summary_row(key: tuple[str, ...], members: list[dict[str, Any]]) -> dict[str, Any]:
    row: dict[str, Any] = {**dict(zip(GROUP, key, strict=True)), "trajectories": len(members)}
    for name in AVERAGED:
        if any(name in m for m in members):
            row[f"{name}_mean"], row[f"{name}_worst"] = mean_and_worst([m.get(name, math.nan) for m in members])
    if any("ms_p50" in m for m in members):
        row["nodes_mean"] = float(np.mean([m["nodes"] for m in members]))
        row["frames"] = int(max(m["frames"] for m in members))
        row["diverged"] = sum(m["diverged_at"] is not None for m in members)
        checked = [m for m in members if m["long_frames"] is not None]
        row["long_frames"] = max((m["long_frames"] for m in checked), default=0)
        row["long_checked"] = len(checked)
        row["long_diverged"] = sum(m["long_diverged_at"] is not None for m in checked)
        row["frequencies"] = sum(not math.isnan(m["true_frequency_hz"]) for m in members)
        row["frequencies_lost"] = sum(
            math.isnan(m["frequency_hz"]) and not math.isnan(m["true_frequency_hz"]) for m in members
        )
        row["entropy_min"] = _least(m["entropy_min"] for m in members)
        for name in sorted({k for m in members for k in m if k.startswith("probe_")}):
            values = [m.get(name, math.nan) for m in members]
            row[name] = _least(values) if name == "probe_entropy_production" else mean_and_worst(values)[1]
        row["ms_p50"] = _middle([m["ms_p50"] for m in members])
        row["ms_p95"] = _middle([m["ms_p95"] for m in members])
    return row


def _least(values: Iterable[float]) -> float:
    defined = [v for v in values if not math.isnan(v)]
    return min(defined) if defined else math.nan


def _middle(values: Iterable[float]) -> float:
    defined = [v for v in values if not math.isnan(v)]
    return float(np.median(defined)) if defined else math.nan


def write_all(folder: Path, rows: list[dict[str, Any]], curves: list[dict[str, Any]], summary: dict[str, Any]) -> None:
    """Writes metrics.csv, errors_over_time.csv and summary.{csv,md,json} into `folder`."""
    write_csv(folder / "metrics.csv", rows)
    write_csv(folder / "errors_over_time.csv", curves)
    write_csv(folder / "summary.csv", summary["rows"])
    with atomic_path(folder / "summary.md") as beside:
        beside.write_text(markdown(summary["rows"], summary["threads"]))
    with atomic_path(folder / "summary.json") as beside:
        beside.write_text(json.dumps(_plain(summary), indent=1) + "\n")


def write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Writes rows with the union of their keys as columns, in order of appearance; None and NaN become empty."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with atomic_path(path) as beside, beside.open("w", newline="") as lines:
        writer = csv.DictWriter(lines, columns, restval="")
        writer.writeheader()
        writer.writerows({k: _cell(v) for k, v in row.items()} for row in rows)


def _cell(value: Any) -> Any:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return f"{value:.6g}" if isinstance(value, float) else value


def _plain(value: Any) -> Any:
    """The same with numbers that JSON knows: NaN becomes null, infinity the word "inf"."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else ("inf" if value > 0 else "-inf")
    return value


def markdown(rows: Sequence[dict[str, Any]], threads: int) -> str:
    """A table for people: errors in percent as mean (worst), milliseconds per frame as median / 95th percentile."""
    head = [
        "method",
        "split",
        "regime",
        "n",
        "nodes",
        "position %",
        "displacement %",
        "velocity %",
        "stress %",
        "von Mises %",
        "frequency %",
        "diverged",
        "ms per frame",
    ]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * 3 + "---:|" * (len(head) - 3)]
    for row in rows:
        errors = [_percent(row, f"{f}_rrmse") for f in ("position", "displacement", "velocity", "stress", "von_mises")]
        cells = [
            row["method"],
            row["split"],
            row["regime"],
            str(row["trajectories"]),
            f"{row['nodes_mean']:.0f}",
            *errors,
            _percent(row, "frequency_error"),
            _divergence(row),
            "-" if math.isnan(row["ms_p50"]) else f"{row['ms_p50']:.2f} / {row['ms_p95']:.2f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    note = (
        "RRMSE in percent, mean over the trajectories (worst in brackets), all frames but the first, free nodes; "
        "static is a picture in which nothing moves. Milliseconds per frame: median / 95th percentile, "
        f"{threads} thread(s), CPU."
    )
    return "\n".join([*lines, "", note, ""])


def _percent(row: dict[str, Any], name: str) -> str:
    mean, worst = row.get(f"{name}_mean", math.nan), row.get(f"{name}_worst", math.nan)
    return "-" if math.isnan(mean) else f"{_three(100 * mean)} ({_three(100 * worst)})"


def _three(value: float) -> str:
    """Three significant digits without an exponent; `> 9999` where a rollout is off the scale."""
    if value >= 9999.5:
        return "> 9999"
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def _divergence(row: dict[str, Any]) -> str:
    short = f"{row['diverged']}/{row['trajectories']}"
    if not row["long_checked"]:
        return short
    return f"{short}; {row['long_diverged']}/{row['long_checked']} in {row['long_frames']} frames"
