"""Time series and texts of a recording of a liquid: centroid, surface, errors, energies, milliseconds."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import rerun as rr
from jaxtyping import Float

from zsdt.evaluation.liquid_metrics import Swing, field_energies, outside
from zsdt.evaluation.metrics import errors_over_time, field_errors, rrmse
from zsdt.evaluation.sloshing import swing_figures
from zsdt.tignn.engine import Rollout
from zsdt.trajectory import Trajectory
from zsdt.twin.timeline import send_line

_PREDICTION, _TRUTH = (255, 140, 40), (110, 190, 255)
_ERRORS = {
    "displacement": (255, 140, 40),
    "velocity": (110, 190, 255),
    "energy_increment": (205, 120, 220),
}
_ENERGIES = {"kinetic": (110, 190, 255), "potential": (255, 210, 60), "internal": (240, 90, 80)}
_TOTAL = (235, 235, 235)
Fields = Mapping[str, Float[np.ndarray, "frames nodes _"]]


def send(
    stream: rr.RecordingStream,
    trajectory: Trajectory,
    rollout: Rollout,
    predicted: Fields,
    truth: Fields,
    swing: Swing,
    true_swing: Swing,
) -> None:
    """Sends all time series of a rollout of a liquid."""
    body, times = trajectory.body, trajectory.times
    count = len(truth["position"])

    def line(entity: str, values: np.ndarray, name: str, colour: tuple[int, int, int], first: int = 0) -> None:
        send_line(stream, entity, times, values, name, colour, first)

    for side, motion, colour in (("truth", true_swing, _TRUTH), ("prediction", swing, _PREDICTION)):
        line(f"centroid/{side}", 1e3 * motion.along, side, colour)
        line(f"surface/{side}_front", 1e3 * motion.levels[:, 0], f"{side}, in front", colour)
        line(f"surface/{side}_back", 1e3 * motion.levels[:, 1], f"{side}, behind", _dim(colour))
    for name, curve in errors_over_time(predicted, truth, ~body.clamped).items():
        if name in _ERRORS:
            line(f"error/{name}", 100 * curve, name.replace("_", " "), _ERRORS[name])
    theirs = field_energies(body, truth)
    for before, account in (("", field_energies(body, predicted)), ("true ", theirs)):
        whole = len(account) == len(_ENERGIES)
        total = sum(account.values()) - sum(v[0] for v in theirs.values()) if whole else np.full(count, np.nan)
        for name, values in account.items():
            start = 0.0 if name == "kinetic" else theirs[name][0]
            colour = _dim(_ENERGIES[name]) if before else _ENERGIES[name]
            line(f"energy/{before.strip()}{'_' if before else ''}{name}", 1e3 * (values - start), before + name, colour)
        line(
            f"energy/{before.strip()}{'_' if before else ''}total",
            1e3 * np.asarray(total),
            f"{before}total",
            _dim(_TOTAL) if before else _TOTAL,
        )
    line("latency/frame", rollout.milliseconds[: count - 1], "one frame", _PREDICTION, first=1)
    if np.nansum(rollout.graph_milliseconds) > 0:
        line("latency/graph", rollout.graph_milliseconds[: count - 1], "of that its graph", (205, 120, 220), first=1)
    line("latency/budget", np.full(count - 1, 1e3 * body.frame_dt), "real time", _TRUTH, first=1)


def _dim(colour: tuple[int, int, int]) -> tuple[int, int, int]:
    red, green, blue = colour
    return red // 2, green // 2, blue // 2


def about(
    trajectory: Trajectory, rollout: Rollout, predicted: Fields, truth: Fields, swing: Swing, true_swing: Swing
) -> str:
    """What is seen here, in Markdown: liquid, vessel, errors, swing, leaks, speed."""
    body = trajectory.body
    liquid = body.liquid.name if body.liquid is not None else "liquid"
    family = body.vessel.family.value if body.vessel is not None else "vessel"
    errors = field_errors(predicted, truth, ~body.clamped)
    lines = [
        f"# {rollout.name} on {trajectory.name}",
        f"{liquid.capitalize()} in a {family} that has just stopped: {body.nodes} particles "
        f"{1e3 * body.pitch:.1f} mm apart, {len(truth['position'])} frames of {1e3 * body.frame_dt:.3g} ms. "
        "Left the prediction, right the truth (a simulation); blue marks on the left glass are the true heights of the "
        "surface at the wall.",
        "",
        "| field | RRMSE % | RMSE |",
        "|---|---:|---:|",
    ]
    units = {"displacement": "m", "position": "m", "velocity": "m/s", "energy_increment": "J/kg"}
    for name, unit in units.items():
        if f"{name}_rrmse" in errors:
            share, absolute = errors[f"{name}_rrmse"], errors[f"{name}_rmse"]
            lines.append(f"| {name.replace('_', ' ')} | {100 * share:.3g} | {absolute:.3g} {unit} |")
    paths = [side.centroid[1:, None, :2] - true_swing.centroid[0, :2] for side in (swing, true_swing)]
    gap = np.sqrt(np.mean((swing.levels[1:] - true_swing.levels[1:]) ** 2))
    leaked, spilled = outside(body, predicted["position"])
    lines += [
        f"| centroid | {100 * rrmse(*paths):.3g} | |",
        f"| surface at the wall | | {1e3 * gap:.2g} mm |",
        "",
        _swing_sentence(trajectory, swing, true_swing),
        f"Leaked particles: {len(leaked)}; spilled over the rim: {len(spilled)}.",
        "",
        *_clock_lines(trajectory, rollout),
        "Tabs above choose the field and the plots, the slider below the frame.",
    ]
    return "\n".join(lines)


def _swing_sentence(trajectory: Trajectory, swing: Swing, true_swing: Swing) -> str:
    body = trajectory.body
    figures = swing_figures(swing.along, true_swing.along, body.frame_dt, body.pitch)
    if math.isnan(figures["true_frequency_hz"]):
        return "The true centroid does not swing clearly."
    truth = f"{figures['true_frequency_hz']:.2f} Hz, damping ratio {figures['true_damping']:.2f}"
    if math.isnan(figures["frequency_hz"]):
        return f"The true centroid swings with {truth}; the predicted one does not swing."
    ours = f"{figures['frequency_hz']:.2f} Hz, {figures['damping']:.2f}"
    return f"Centroid: {ours} (truth: {truth})."


def _clock_lines(trajectory: Trajectory, rollout: Rollout) -> list[str]:
    clock = rollout.milliseconds[np.isfinite(rollout.milliseconds)]
    if len(clock) == 0:
        return []
    ahead = 1e3 * trajectory.body.frame_dt / np.median(clock)
    graph = float(np.nansum(rollout.graph_milliseconds)) / max(len(clock), 1)
    share = f", of that {graph:.2f} ms for its graph on average" if graph > 0 else ""
    text = f"One frame: {np.median(clock):.2f} ms (95th percentile {np.percentile(clock, 95):.2f} ms{share})"
    return [f"{text}, {ahead:.3g} times real time.", ""]
