"""The plots of a report, chosen from its methods; each is also kept as a PNG beside the page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.gather import Method
from pipelines.twin_factors import FactorPart
from zsdt.evaluation.plots import FROM_PSI_INI, Curve, Point, error_against_factors, error_against_time, error_over_time
from zsdt.files import atomic_path

QUANTITY = "displacement error (RRMSE)"
NOT_IN_TIME_PLOT = ("inertia", FROM_PSI_INI)


class Plots:
    """Makes plots and keeps them in `folder`."""

    def __init__(self, folder: Path):
        self.folder = folder

    def _keep(self, name: str, png: bytes) -> bytes:
        with atomic_path(self.folder / f"{name}.png") as beside:
            beside.write_bytes(png)
        return png

    def pareto(self, key: str, methods: Sequence[Method]) -> bytes:
        """Displacement error against milliseconds per frame, a panel per regime."""
        panels = {
            regime: [
                Point(
                    method.name,
                    method.mean("displacement_rrmse_mean", regime),
                    method.mean("ms_p50", regime),
                    method.label,
                )
                for method in methods
                if regime in method.regimes()
            ]
            for regime in regimes_of(methods)
        }
        return self._keep(f"{key}_error_against_milliseconds", error_against_time(panels, QUANTITY))

    def over_time(self, key: str, methods: Sequence[Method]) -> bytes:
        """Displacement error over the rollout of the best of each kind of method, a panel per regime."""
        panels = {}
        for regime in regimes_of(methods):
            chosen = [m for m in best_of_each(methods, regime) if not m.name.endswith(NOT_IN_TIME_PLOT)]
            panels[regime] = [curve for method in chosen if (curve := curve_of(method, regime)) is not None]
        return self._keep(f"{key}_error_over_time", error_over_time(panels, QUANTITY))

    def factors(self, key: str, methods: Sequence[Method], factors: Sequence[str], regime: str) -> bytes:
        """Displacement error of a regime against each swept factor."""
        rows: list[dict[str, Any]] = [
            {
                "method": method.name,
                "error": method.mean("displacement_rrmse_mean", regime),
                **{name: method.options.get(name) for name in factors},
            }
            for method in methods
        ]
        return self._keep(f"{key}_{regime}_factors", error_against_factors(rows, factors, f"{regime}: {QUANTITY}"))

    def twin_factors(self, part: FactorPart) -> bytes:
        """Errors of twins against each swept option of a part of the sweep."""
        return self._keep(f"{part.jobs[0].experiment}_{part.name}", part.picture())


def regimes_of(methods: Sequence[Method]) -> list[str]:
    """All regimes of the methods."""
    return sorted({regime for method in methods for regime in method.regimes()})


def best_of_each(methods: Sequence[Method], regime: str) -> list[Method]:
    """Of each name the method with the least displacement error, in order of appearance."""
    best: dict[str, tuple[float, Method]] = {}
    for method in methods:
        error = method.mean("displacement_rrmse_mean", regime)
        if method.name not in best or error < best[method.name][0]:
            best[method.name] = (error, method)
    return [method for _, method in best.values()]


def curve_of(method: Method, regime: str) -> Curve | None:
    """Median and middle half over the trajectories of a regime at each time that the most of them have."""
    at: dict[float, list[float]] = {}
    for row in method.curves:
        if row["regime"] == regime and row["displacement"] not in ("", "inf") and int(row["frame"]) > 0:
            at.setdefault(round(float(row["time_s"]), 6), []).append(float(row["displacement"]))
    most = max((len(values) for values in at.values()), default=0)
    times = sorted(time for time, values in at.items() if 2 * len(values) > most)
    if not times:
        return None
    low, middle, high = np.array([np.percentile(at[time], [25, 50, 75]) for time in times]).T
    return Curve(method.name, method.name, np.array(times), middle, low, high)
