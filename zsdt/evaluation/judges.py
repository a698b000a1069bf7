"""What a rollout is judged by: a solid by its stress and its tip, a liquid by its surface, its swing and its vessel.

A judge is made once for a trajectory and looks at the rollouts of all methods on it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from zsdt.evaluation.ledger import ledger_figures
from zsdt.evaluation.liquid_metrics import Swing, field_energies, liquid_figures, swing_of
from zsdt.evaluation.metrics import error_growth, errors_over_time, field_errors
from zsdt.evaluation.modal import frequencies
from zsdt.tignn.engine import Rollout
from zsdt.trajectory import Trajectory

Series = dict[str, Float[np.ndarray, " frames"]]


@runtime_checkable
class Judge(Protocol):
    """Figures and curves of rollouts of one trajectory."""

    def figures(self, rollout: Rollout) -> dict[str, float]:
        """One number per figure: errors of fields and what else counts for this kind of body."""

    def curves(self, rollout: Rollout) -> Series:
        """Relative error per field and frame, and what else can be drawn over time."""

    def pictures(self, rollouts: Mapping[str, Rollout]) -> dict[str, bytes]:
        """PNGs by title that show methods (name -> rollout) beside the truth."""


def judge_of(trajectory: Trajectory, quality: float) -> Judge:
    """The judge for this kind of body; `quality` is what the fit of a solid's frequency must reach."""
    return SolidJudge(trajectory, quality) if trajectory.body.liquid is None else LiquidJudge(trajectory)


class SolidJudge:
    """Errors of the fields, the frequency of the tip, the energy account."""

    def __init__(self, trajectory: Trajectory, quality: float):
        self.trajectory, self.quality = trajectory, quality

    def figures(self, rollout: Rollout) -> dict[str, float]:
        """`<field>_rmse`, `<field>_rrmse`, error_growth, frequency_hz and its error, figures of the account."""
        trajectory = self.trajectory
        free = ~trajectory.body.clamped
        ours, theirs = frequencies(
            trajectory.body,
            rollout.fields["position"],
            trajectory.fields["position"],
            trajectory.load,
            self.quality,
        )
        return {
            **field_errors(rollout.fields, trajectory.fields, free),
            "error_growth": error_growth(self.curves(rollout)["displacement"]),
            "frequency_hz": ours,
            "true_frequency_hz": theirs,
            "frequency_error": abs(ours / theirs - 1.0),
            **ledger_figures(rollout, trajectory),
        }

    def curves(self, rollout: Rollout) -> Series:
        """Relative error of each field at each frame."""
        return errors_over_time(rollout.fields, self.trajectory.fields, ~self.trajectory.body.clamped)

    def pictures(self, rollouts: Mapping[str, Rollout]) -> dict[str, bytes]:
        """None: the recordings show more."""
        return {}


class LiquidJudge:
    """Errors of the fields, and all of `zsdt.evaluation.liquid_metrics`.

    truth: the true motion as a whole; what it says of a rollout is kept until another rollout comes.
    """

    def __init__(self, trajectory: Trajectory):
        self.trajectory = trajectory
        self.truth = swing_of(trajectory.body, trajectory.fields["position"])
        self._last: tuple[Rollout, Swing] | None = None

    def swing(self, rollout: Rollout) -> Swing:
        """The predicted motion as a whole, along the direction of the true one."""
        if self._last is None or self._last[0] is not rollout:
            position = rollout.fields["position"]
            self._last = (rollout, swing_of(self.trajectory.body, position, self.truth.direction))
        return self._last[1]

    def figures(self, rollout: Rollout) -> dict[str, float]:
        """`<field>_rmse`, `<field>_rrmse`, error_growth, those of `liquid_figures`, of the energy account and of time.

        The solver's account is its own where the file has one, and taken from the true fields where it has none.
        """
        trajectory = self.trajectory
        free = ~trajectory.body.clamped
        account = rollout.account or field_energies(trajectory.body, rollout.fields)
        booked = Rollout(rollout.name, rollout.fields, rollout.milliseconds, account)
        ledger = trajectory.ledger or field_energies(trajectory.body, trajectory.fields)
        return {
            **field_errors(rollout.fields, trajectory.fields, free),
            "error_growth": error_growth(errors_over_time(rollout.fields, trajectory.fields, free)["displacement"]),
            **liquid_figures(trajectory, rollout, self.truth, self.swing(rollout)),
            **ledger_figures(booked, replace(trajectory, ledger=ledger)),
            **_shares_of_time(rollout),
        }

    def curves(self, rollout: Rollout) -> Series:
        """Relative error of each field at each frame; centroid along the swing and levels at the wall [m], both
        sides."""
        curves = errors_over_time(rollout.fields, self.trajectory.fields, ~self.trajectory.body.clamped)
        count = len(curves["position"])
        for before, side in (("", self.swing(rollout)), ("true_", self.truth)):
            curves[f"{before}centroid_m"] = side.along[:count]
            curves[f"{before}front_level_m"] = side.levels[:count, 0]
            curves[f"{before}back_level_m"] = side.levels[:count, 1]
        return curves

    def pictures(self, rollouts: Mapping[str, Rollout]) -> dict[str, bytes]:
        """snapshots, sloshing and energy: see `zsdt.evaluation.liquid_plots`."""
        from zsdt.evaluation import liquid_plots  # matplotlib is slow to load; only who draws pays for it

        swings = {name: self.swing(rollout) for name, rollout in rollouts.items()}
        return {
            "snapshots": liquid_plots.snapshots(self.trajectory, rollouts, self.truth.direction),
            "sloshing": liquid_plots.sloshing(self.trajectory.times, self.truth, swings),
            "energy": liquid_plots.energies(self.trajectory, rollouts),
        }


def _shares_of_time(rollout: Rollout) -> dict[str, float]:
    """Milliseconds per frame that went into the graph (mean too: most frames build none) and into the rest."""
    if len(rollout.graph_milliseconds) != len(rollout.milliseconds):
        return {}
    both = np.isfinite(rollout.milliseconds) & np.isfinite(rollout.graph_milliseconds)
    if not both.any():
        return {}
    graph = rollout.graph_milliseconds[both]
    rest = rollout.milliseconds[both] - graph
    return {
        "graph_ms_mean": float(graph.mean()),
        "graph_ms_p50": float(np.median(graph)),
        "graph_ms_p95": float(np.percentile(graph, 95)),
        "network_ms_p50": float(np.median(rest)),
        "network_ms_p95": float(np.percentile(rest, 95)),
    }


def milliseconds(rollout: Rollout) -> dict[str, float]:
    """Median and 95th percentile of the time of a frame [ms]; NaN where no frame was timed."""
    clock = rollout.milliseconds[np.isfinite(rollout.milliseconds)]
    if len(clock) == 0:
        return {"ms_p50": math.nan, "ms_p95": math.nan}
    return {"ms_p50": float(np.median(clock)), "ms_p95": float(np.percentile(clock, 95))}
