"""Tables of an evaluation: CSV for machines, Markdown for people, JSON for the next stage."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
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
    "velocity_x_rmse",
    "velocity_y_rmse",
    "velocity_z_rmse",
    "stress_rmse",
    "von_mises_rmse",
    "axial_stress_rmse",
    "internal_energy_rrmse",
    "internal_energy_rmse",
    "internal_energy_level",
    "energy_increment_rrmse",
    "energy_increment_rmse",
    "centroid_rrmse",
    "centroid_rmse",
    "level_rrmse",
    "level_rmse",
    "peak_level_error",
    "frequency_error",
    "damping_error",
    "volume_error",
    "density_error",
    "leaked",
    "spilled",
    "close_share",
    "true_close_share",
    "kinetic_ratio",
    "kinetic_factor",
    "long_kinetic",
    "energy_drift",
    "momentum_rrmse",
    "error_growth",
    "ledger_residual",
    "kinetic_account_rrmse",
    "potential_account_rrmse",
    "elastic_account_rrmse",
    "dissipated_account_rrmse",
    "internal_account_rrmse",
    "work_of_ports_account_rrmse",
)

CLOCKS = ("ms_p50", "ms_p95", "graph_ms_mean", "graph_ms_p50", "graph_ms_p95", "network_ms_p50", "network_ms_p95")


def summarise(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row per method, split and regime: trajectories, their families, mean and worst of every error, counts of
    divergence, milliseconds per frame (medians over the trajectories of their median and 95th percentile; of what
    builds its graph anew also the shares of graph and network), mean node count.
    """
    groups: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(str(row[k]) for k in GROUP), []).append(row)
    return [_summary_row(key, members) for key, members in groups.items()]


def _summary_row(key: tuple[str, ...], members: list[dict[str, Any]]) -> dict[str, Any]:
    row: dict[str, Any] = {**dict(zip(GROUP, key, strict=True)), "trajectories": len(members)}
    if any("family" in m for m in members):
        row["families"] = " ".join(sorted({str(m["family"]) for m in members}))
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
        for name in CLOCKS:
            if any(name in m for m in members):
                row[name] = _middle([m.get(name, math.nan) for m in members])
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


def is_of_liquids(rows: Iterable[Mapping[str, Any]]) -> bool:
    """Whether rows of a summary are about liquids: they have a centroid."""
    return any("centroid_rrmse_mean" in row for row in rows)


def shown_errors(rows: Iterable[Mapping[str, Any]]) -> tuple[str, ...]:
    """Names of the fields whose RRMSE a short table shows, for the kind of body that the rows are about."""
    if is_of_liquids(rows):
        return ("displacement", "position", "velocity", "energy_increment", "centroid")
    return ("displacement", "position", "velocity", "stress")


def markdown(rows: Sequence[dict[str, Any]], threads: int) -> str:
    """A table for people: errors in percent as mean (worst), milliseconds per frame as median / 95th percentile."""
    liquid = is_of_liquids(rows)
    layout = _LIQUID if liquid else _SOLID
    lines = ["| " + " | ".join(layout) + " |", "|" + "---|" * 3 + "---:|" * (len(layout) - 3)]
    lines += ["| " + " | ".join(cell(row) for cell in layout.values()) + " |" for row in rows]
    note = (
        "RRMSE in percent, mean over the trajectories (worst in brackets), all frames but the first, free nodes; "
        "static is a picture in which nothing moves. Milliseconds per frame: median / 95th percentile, "
        f"{threads} thread(s), CPU."
    )
    return "\n".join([*lines, "", f"{note} {LIQUID_NOTE}" if liquid else note, ""])


LIQUID_NOTE = (
    "Energy increment: internal energy since the first frame (the plain error is relative to the mean level beside "
    "it). Level: RMS error of the surface at the wall, in front and behind. Frequency and damping: of the centroid, "
    "where truth and prediction both swing (lost: only the truth does). Leaks: particles that were ever beyond the "
    "wall, most of any trajectory. Close: share nearer than half a spacing to another. Kinetic: factor between the "
    "kinetic energies over the last tenth. Milliseconds after =: graph building (mean, for most frames build none) + "
    "the rest (median)."
)
Cell = Callable[[dict[str, Any]], str]


def _error(name: str) -> Cell:
    return lambda row: _percent(row, name)


def _millimetres(name: str) -> Cell:
    def cell(row: dict[str, Any]) -> str:
        mean, worst = row.get(f"{name}_mean", math.nan), row.get(f"{name}_worst", math.nan)
        return "-" if math.isnan(mean) else f"{_three(1e3 * mean)} ({_three(1e3 * worst)})"

    return cell


def _factor(name: str) -> Cell:
    return lambda row: f"{_three(row.get(f'{name}_mean', math.nan))} ({_three(row.get(f'{name}_worst', math.nan))})"


def _plain_energy(row: dict[str, Any]) -> str:
    level = row.get("internal_energy_level_mean", math.nan)
    error = row.get("internal_energy_rrmse_mean", math.nan)
    return "-" if math.isnan(error) else f"{_three(100 * error)} of {level:.3g} J/kg"


def _swing_error(name: str) -> Cell:
    def cell(row: dict[str, Any]) -> str:
        lost = row.get("frequencies_lost", 0)
        return _percent(row, name) + (f", {lost} lost" if lost else "")

    return cell


def _leaks(row: dict[str, Any]) -> str:
    leaked, spilled = row.get("leaked_worst", math.nan), row.get("spilled_worst", 0.0)
    return "-" if math.isnan(leaked) else f"{leaked:.0f}" + (f" + {spilled:.0f} spilled" if spilled else "")


def _close(row: dict[str, Any]) -> str:
    return f"{_percent(row, 'close_share')}, truth {_three(100 * row.get('true_close_share_mean', math.nan))}"


def _clock(row: dict[str, Any]) -> str:
    return "-" if math.isnan(row["ms_p50"]) else f"{row['ms_p50']:.2f} / {row['ms_p95']:.2f}"


def _split_clock(row: dict[str, Any]) -> str:
    graph, network = row.get("graph_ms_mean", 0.0), row.get("network_ms_p50", math.nan)
    return _clock(row) if not graph or math.isnan(network) else f"{_clock(row)} = {graph:.2f} + {network:.2f}"


_SOLID: dict[str, Cell] = {
    "method": lambda row: row["method"],
    "split": lambda row: row["split"],
    "regime": lambda row: row["regime"],
    "n": lambda row: str(row["trajectories"]),
    "nodes": lambda row: f"{row['nodes_mean']:.0f}",
    "position %": _error("position_rrmse"),
    "displacement %": _error("displacement_rrmse"),
    "velocity %": _error("velocity_rrmse"),
    "stress %": _error("stress_rrmse"),
    "von Mises %": _error("von_mises_rrmse"),
    "frequency %": _error("frequency_error"),
    "diverged": lambda row: _divergence(row),
    "ms per frame": _clock,
}
_LIQUID: dict[str, Cell] = {
    "method": lambda row: row["method"],
    "split": lambda row: f"{row['split']}: {row.get('families', '')}",
    "regime": lambda row: row["regime"],
    "n": lambda row: str(row["trajectories"]),
    "nodes": lambda row: f"{row['nodes_mean']:.0f}",
    "displacement %": _error("displacement_rrmse"),
    "position %": _error("position_rrmse"),
    "velocity %": _error("velocity_rrmse"),
    "energy increment %": _error("energy_increment_rrmse"),
    "energy, plain %": _plain_energy,
    "centroid %": _error("centroid_rrmse"),
    "frequency %": _swing_error("frequency_error"),
    "damping %": _error("damping_error"),
    "level mm": _millimetres("level_rmse"),
    "volume %": _error("volume_error"),
    "leaks": _leaks,
    "close %": _close,
    "kinetic x": _factor("kinetic_factor"),
    "diverged": lambda row: _divergence(row),
    "ms per frame": _split_clock,
}


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
