"""Time series and texts of a recording: how the tip moves, how large the errors are, what became of the energy."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import rerun as rr
from jaxtyping import Float

from zsdt.evaluation.ledger import LEARNED_ENERGY, WORK, closure, heat, total_energy, work_of_ports
from zsdt.evaluation.metrics import errors_over_time, field_errors
from zsdt.evaluation.modal import tip_trace
from zsdt.tignn.engine import Rollout
from zsdt.trajectory import Trajectory
from zsdt.twin.timeline import send_line

PREDICTION, TRUTH = (255, 140, 40), (110, 190, 255)
_ERRORS = {
    "displacement": (255, 140, 40),
    "velocity": (110, 190, 255),
    "stress": (205, 120, 220),
    "von_mises": (120, 210, 130),
}
ENERGIES = {
    "kinetic": (110, 190, 255),
    "elastic": (120, 210, 130),
    "dissipated": (240, 90, 80),
    WORK: (255, 210, 60),
}


def send(
    stream: rr.RecordingStream,
    trajectory: Trajectory,
    rollout: Rollout,
    predicted: Mapping[str, Float[np.ndarray, "frames nodes _"]],
    truth: Mapping[str, Float[np.ndarray, "frames nodes _"]],
) -> None:
    """Sends all time series; those that the rollout has no numbers for are left out."""
    body, times = trajectory.body, trajectory.times
    count = len(truth["position"])

    def line(entity: str, values: np.ndarray, name: str, colour: tuple[int, int, int], first: int = 0) -> None:
        send_line(stream, entity, times, values, name, colour, first)

    axis = main_axis(truth["position"], trajectory)
    for side, fields, colour in (("truth", truth, TRUTH), ("prediction", predicted, PREDICTION)):
        tip = tip_trace(body, fields["position"])[:, axis] - tip_trace(body, truth["position"])[0, axis]
        line(f"tip/{side}", 1e3 * tip, f"{side} {'xyz'[axis]}", colour)
    curves = errors_over_time(predicted, truth, ~body.clamped)
    for name, colour in _ERRORS.items():
        if name in curves:
            line(f"error/{name}", 100 * curves[name], name.replace("_", " "), colour)
    ours, theirs = dict(rollout.account), dict(trajectory.ledger)
    for account in (ours, theirs):
        work = work_of_ports(account)
        if work is not None:
            account[WORK] = work
    if LEARNED_ENERGY in ours:
        line("energy/learned", ours[LEARNED_ENERGY][:count], f"learned energy{_own_units(ours)}", ENERGIES["elastic"])
    for name, colour in ENERGIES.items():
        words = name.replace("_", " ")
        if name in ours:
            line(f"energy/{name}", ours[name][:count] - ours[name][0], words, colour)
        if name in theirs:
            red, green, blue = colour
            dim = (red // 2, green // 2, blue // 2)
            line(f"energy/true_{name}", theirs[name][:count] - theirs[name][0], f"true {words}", dim)
    for side, account, colour in (("prediction", ours, PREDICTION), ("truth", theirs, TRUTH)):
        booked = heat(account)
        if booked is not None:
            watts = np.diff(booked[:count]) / np.diff(times[:count])
            line(f"dissipation/{side}", watts, f"{side}{_own_units(account)}", colour, first=1)
    line("latency/frame", rollout.milliseconds[: count - 1], "one frame", PREDICTION, first=1)
    budget = np.full(count - 1, 1e3 * body.frame_dt)
    line("latency/budget", budget, "real time", TRUTH, first=1)


def main_axis(position: Float[np.ndarray, "frames nodes 3"], trajectory: Trajectory) -> int:
    """The direction (0 x, 1 y, 2 z) along which the true tip moves most."""
    return int(np.argmax(np.ptp(tip_trace(trajectory.body, position), axis=0)))


def about(
    trajectory: Trajectory,
    rollout: Rollout,
    predicted: Mapping[str, Float[np.ndarray, "frames nodes _"]],
    truth: Mapping[str, Float[np.ndarray, "frames nodes _"]],
) -> str:
    """What is seen here, in Markdown: body, errors, speed, energy account, and how to use the viewer."""
    body = trajectory.body
    size = " x ".join(f"{100 * s:.0f}" for s in np.ptp(body.points, axis=0))
    errors = field_errors(predicted, truth, ~body.clamped)
    clock = rollout.milliseconds[np.isfinite(rollout.milliseconds)]
    lines = [
        f"# {rollout.name} on {trajectory.name}",
        f"{size} cm, {body.nodes} nodes, {len(truth['position'])} frames of {1e3 * body.frame_dt:.3g} ms, "
        f"regime *{trajectory.meta.get('regime', 'unknown')}*. "
        "Above the prediction, below the truth (a simulation); the blue outline is the truth around the prediction, "
        "the yellow arrow the load, grey points the clamp.",
        "",
        "| field | RRMSE % | RMSE |",
        "|---|---:|---:|",
    ]
    units = {"position": "m", "displacement": "m", "velocity": "m/s", "stress": "Pa", "von_mises": "Pa"}
    for name, unit in units.items():
        if f"{name}_rrmse" in errors:
            share, absolute = errors[f"{name}_rrmse"], errors[f"{name}_rmse"]
            lines.append(f"| {name.replace('_', ' ')} | {100 * share:.3g} | {absolute:.3g} {unit} |")
    if len(clock):
        ahead = 1e3 * body.frame_dt / np.median(clock)
        lines += [
            "",
            f"One frame: {np.median(clock):.2f} ms (95th percentile {np.percentile(clock, 95):.2f} ms), "
            f"{ahead:.3g} times real time.",
        ]
    lines += ["", *_account_lines(rollout), "Tabs above choose the field, the slider below the frame."]
    return "\n".join(lines)


def _own_units(account: Mapping[str, np.ndarray]) -> str:
    """A learned energy is counted in units of the network's own."""
    return " (own units)" if LEARNED_ENERGY in account else ""


def _account_lines(rollout: Rollout) -> list[str]:
    gap = closure(rollout.account)
    energy, work = total_energy(rollout.account), work_of_ports(rollout.account)
    if gap is None or energy is None or work is None:
        return []
    known = np.flatnonzero(np.isfinite(gap))
    last = known[-1]
    unit = "units of its own" if LEARNED_ENERGY in rollout.account else "J"
    return [
        f"Energy changed by {energy[last] - energy[0]:.4g} {unit}, the ports (load, gravity) did "
        f"{work[last] - work[0]:.4g}; largest gap {100 * np.abs(gap[known]).max():.2g} % of the turnover.",
        "",
    ]
