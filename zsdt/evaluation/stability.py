"""Whether a rollout stayed where bodies can be: in its own frames and in many more."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from zsdt.evaluation.liquid_metrics import field_energies
from zsdt.fluid.vessel import Vessel
from zsdt.tignn.engine import Engine, Rollout, roll_out
from zsdt.trajectory import Body, Trajectory


def left_range(trajectory: Trajectory, rollout: Rollout) -> int | None:
    """First frame that is not finite, in which a node is further than a body length from its reference place, or in
    which a particle is more than a spacing behind the wall of its vessel.

    A rollout can be wrong without end and still be finite, so the second half of the question matters. The length
    of a liquid is the diagonal of its vessel.
    """
    body = trajectory.body
    position = rollout.fields["position"]
    with np.errstate(invalid="ignore"):
        inside = np.linalg.norm(position - body.points, axis=2).max(axis=1) <= _length(body)
    if body.vessel is not None:
        inside[inside] = ~_leaked(body, position[inside])
    outside = np.flatnonzero(~inside)
    return int(outside[0]) if len(outside) else None


def _length(body: Body) -> float:
    corners = body.points if body.vessel is None else np.stack(Vessel(body.vessel).bounds())
    return float(np.linalg.norm(np.ptp(corners, axis=0)))


def _leaked(body: Body, position: Float[np.ndarray, "frames nodes 3"]) -> np.ndarray:
    """Frames [frames] in which a particle is below the rim and more than a spacing behind the wall."""
    assert body.vessel is not None
    vessel = Vessel(body.vessel)
    behind = vessel.distance(position.reshape(-1, 3)).reshape(position.shape[:2]) < -body.pitch
    return np.asarray((behind & (position[..., 2] <= vessel.rim)).any(axis=1))


def stability_check(engine: Engine, trajectory: Trajectory, frames: int) -> int | None:
    """Rolls out for `frames` frames, the last load held; the frame at which it diverged (`left_range`) or None."""
    return left_range(*_long_run(engine, trajectory, frames))


def long_figures(engine: Engine, trajectory: Trajectory, frames: int) -> dict[str, Any]:
    """long_frames and long_diverged_at (see `stability_check`); of a liquid also long_kinetic: its kinetic energy over
    the last tenth of the long run, over that of the first frame. What has come to rest must stay at rest.
    """
    longer, rollout = _long_run(engine, trajectory, frames)
    figures: dict[str, Any] = {"long_diverged_at": left_range(longer, rollout), "long_frames": frames}
    body = trajectory.body
    if body.liquid is not None:
        kinetic = field_energies(body, rollout.fields)["kinetic"]
        last, start = kinetic[-max(frames // 10, 1) :].mean(), field_energies(body, trajectory.fields)["kinetic"][0]
        figures["long_kinetic"] = float(np.nan_to_num(last / start, nan=np.inf)) if start > 0 else float("nan")
    return figures


def _long_run(engine: Engine, trajectory: Trajectory, frames: int) -> tuple[Trajectory, Rollout]:
    extra = max(frames - trajectory.frames, 0)
    held = np.repeat(trajectory.load[-1:], extra, axis=0)
    longer = replace(
        trajectory,
        times=trajectory.body.frame_dt * np.arange(frames),
        fields={k: np.broadcast_to(v[0], (frames, *v[0].shape)) for k, v in trajectory.fields.items()},  # only a start
        load=np.concatenate([trajectory.load, held])[:frames],
        ledger={},
    )
    return longer, roll_out(engine, longer, frames)
