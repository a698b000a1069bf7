"""What a person sees of a liquid, and what nature demands of it: figures of a rollout beside the truth.

Particles are chaotic, so besides the errors of the fields (`zsdt.evaluation.metrics`) a liquid is judged by its
centroid, its surface at the wall, its frequency and damping, and by what must not happen: leaks, clustering, loss of
volume, energy out of nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from zsdt.evaluation.metrics import rmse, rrmse
from zsdt.evaluation.sloshing import centroid, main_direction, swing_figures
from zsdt.evaluation.wall_level import wall_levels
from zsdt.fluid.vessel import Vessel
from zsdt.tignn.engine import Rollout
from zsdt.trajectory import Body, Trajectory

CLOSE = 0.5  # spacings: nearer than this two particles have clustered
LOOKS = 40  # frames of a rollout in which neighbours are counted
ROUNDING = 1e-3  # spacings: files hold positions in single precision
REACH = 2.0  # spacings: support of the kernel that particles are counted with


@dataclass(frozen=True)
class Swing:
    """A liquid as a whole: direction [3] of the true swing, centroid [frames, 3] m, levels [frames, 2] m at the wall
    in front and behind; of the frames `looked_at` counts: the sorted number densities [1/m3], and nearest: the
    distance of each particle to its nearest neighbour [m].
    """

    direction: Float[np.ndarray, "3"]
    centroid: Float[np.ndarray, "frames 3"]
    levels: Float[np.ndarray, "frames 2"]
    looked_at: Int[np.ndarray, " looks"]
    counts: Float[np.ndarray, "looks nodes"]
    nearest: Float[np.ndarray, "looks nodes"]

    @property
    def along(self) -> Float[np.ndarray, " frames"]:
        """Centroid [m] along the direction of the true swing."""
        return self.centroid @ self.direction


def swing_of(
    body: Body, position: Float[np.ndarray, "frames nodes 3"], direction: Float[np.ndarray, "3"] | None = None
) -> Swing:
    """The motion of a liquid as a whole; `direction` is that of the truth, found here if it is not given."""
    path = centroid(body, position)
    chosen = main_direction(path) if direction is None else direction
    looked_at = np.unique(np.linspace(0, len(position) - 1, min(len(position), LOOKS)).astype(int))
    counts, nearest = np.full((2, len(looked_at), body.nodes), np.nan)
    for k, frame in enumerate(looked_at):
        if np.isfinite(position[frame]).all():
            counts[k], nearest[k] = _neighbours(position[frame], body.pitch)
    return Swing(chosen, path, wall_levels(body, position, chosen), looked_at, counts, nearest)


def _neighbours(points: Float[np.ndarray, "nodes 3"], pitch: float) -> tuple[np.ndarray, np.ndarray]:
    """Sorted number densities (kernel sums) [1/m3] and distances to the nearest neighbour [m]."""
    tree = cKDTree(points)
    reach = REACH * pitch
    pairs = tree.query_pairs(reach, output_type="ndarray")
    distance = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    q = distance / reach
    weight = 21.0 / (2.0 * np.pi * reach**3) * np.concatenate([np.ones(1), (1.0 - q) ** 4 * (1.0 + 4.0 * q)])
    density = np.full(len(points), weight[0])
    nearest = np.full(len(points), reach)
    for side in (0, 1):
        density += np.bincount(pairs[:, side], weight[1:], len(points))
        np.minimum.at(nearest, pairs[:, side], distance)
    return np.sort(density), nearest


def liquid_figures(trajectory: Trajectory, rollout: Rollout, truth: Swing, ours: Swing) -> dict[str, float]:
    """Figures of one rollout of a liquid, lengths in m, the rest as fractions:

    - internal_energy_level [J/kg]: mean of the truth, the reference that the plain error of the energy is relative to;
    - centroid_rmse, centroid_rrmse: of the horizontal way of the centroid since the first frame;
    - level_rmse, level_rrmse: of the surface at the wall, in front and behind; relative to its change since the first
      frame; peak_level_error: of the highest level;
    - frequency_hz, damping and their errors (`zsdt.evaluation.sloshing.swing_figures`);
    - volume_error: mean over time of the relative difference of the volume that the particles take, from their number
      densities; density_error: relative RMS difference of the ordered number densities;
    - leaked, spilled: particles that were ever outside of the wall below and above the rim;
    - close_share, true_close_share: of the particles nearer than half a spacing to another; least_spacing: least
      distance of any two, in spacings;
    - kinetic_ratio: kinetic energy over the last tenth of the rollout, over the truth's; kinetic_factor: that or its
      inverse, whichever is larger;
    - energy_drift: largest change of the total energy (heat included) over the largest change of any part of the
      truth's; momentum_rrmse: of the total momentum.

    NaN or infinite where a rollout left the numbers.
    """
    body = trajectory.body
    position, true_position = rollout.fields["position"], trajectory.fields["position"]
    count = min(len(position), len(true_position))
    leaked, spilled = outside(body, position)
    start = truth.centroid[0, :2]
    both = [side.levels[1:count] for side in (ours, truth)]
    peaks = [levels[:, 0].max() for levels in both]
    return {
        "internal_energy_level": float(np.mean(trajectory.fields["internal_energy"][1:])),
        "centroid_rmse": rmse(*[side.centroid[1:count, None, :2] for side in (ours, truth)]),
        "centroid_rrmse": _since(ours.centroid[1:count, :2], truth.centroid[1:count, :2], start),
        "level_rmse": rmse(*[levels[:, None] for levels in both]),
        "level_rrmse": _since(both[0], both[1], truth.levels[0]),
        "peak_level_error": float(np.nan_to_num(abs(peaks[0] - peaks[1]), nan=np.inf)),
        **swing_figures(ours.along[:count], truth.along[:count], body.frame_dt, body.pitch),
        **_crowding(truth, ours, body.pitch),
        "leaked": float(len(leaked)),
        "spilled": float(len(spilled)),
        **_energies(trajectory, rollout),
    }


def _since(ours: np.ndarray, theirs: np.ndarray, start: np.ndarray) -> float:
    """RRMSE of two series [frames, components], each less the common `start`."""
    return rrmse((ours - start)[:, None], (theirs - start)[:, None])


def outside(
    body: Body, position: Float[np.ndarray, "frames nodes 3"]
) -> tuple[Int[np.ndarray, " leaked"], Int[np.ndarray, " spilled"]]:
    """Particles that were ever beyond the wall: below the rim (leaked), above it only (spilled)."""
    if body.vessel is None:
        none = np.zeros(0, np.int64)
        return none, none
    vessel = Vessel(body.vessel)
    flat = position.reshape(-1, 3)
    known = np.isfinite(flat).all(axis=1)
    beyond = np.zeros(len(flat), bool)
    beyond[known] = vessel.distance(flat[known]) < -ROUNDING * body.pitch
    below = flat[:, 2] <= vessel.rim
    by_frame = (len(position), -1)
    leaked = (beyond & below).reshape(by_frame).any(axis=0)
    spilled = beyond.reshape(by_frame).any(axis=0) & ~leaked
    return np.flatnonzero(leaked), np.flatnonzero(spilled)


def _crowding(truth: Swing, ours: Swing, pitch: float) -> dict[str, float]:
    frames, mine, theirs = np.intersect1d(ours.looked_at, truth.looked_at, return_indices=True)
    later = frames > 0
    counts, true_counts = ours.counts[mine][later], truth.counts[theirs][later]
    nearest, true_nearest = ours.nearest[mine][later] / pitch, truth.nearest[theirs][later] / pitch
    known = np.isfinite(nearest)
    with np.errstate(divide="ignore", over="ignore"):
        volume = (1.0 / counts).sum(axis=1) / (1.0 / true_counts).sum(axis=1)
    return {
        "volume_error": float(np.nan_to_num(np.mean(np.abs(volume - 1.0)), nan=np.inf)),
        "density_error": float(np.nan_to_num(np.sqrt(np.mean((counts / true_counts - 1.0) ** 2)), nan=np.inf)),
        "close_share": float(np.mean(nearest[known] < CLOSE)) if known.any() else float("nan"),
        "true_close_share": float(np.mean(true_nearest < CLOSE)),
        "least_spacing": float(nearest[known].min()) if known.any() else float("nan"),
    }


def field_energies(
    body: Body, fields: Mapping[str, Float[np.ndarray, "frames nodes _"]]
) -> dict[str, Float[np.ndarray, " frames"]]:
    """Energies [J] of a liquid at every frame from its fields: kinetic, potential (zero at the origin), internal."""
    energies = {
        "kinetic": 0.5 * np.einsum("n,tni,tni->t", body.mass, fields["velocity"], fields["velocity"]),
        "potential": -np.einsum("n,tni,i->t", body.mass, fields["position"], body.gravity),
    }
    if "internal_energy" in fields:
        energies["internal"] = fields["internal_energy"][..., 0] @ body.mass
    return energies


def _energies(trajectory: Trajectory, rollout: Rollout) -> dict[str, float]:
    body = trajectory.body
    count = min(len(rollout.fields["position"]), trajectory.frames)
    ours = field_energies(body, {k: v[:count] for k, v in rollout.fields.items()})
    theirs = field_energies(body, {k: v[:count] for k, v in trajectory.fields.items()})
    tail = -max(count // 10, 1)
    momentum = [np.einsum("n,tni->ti", body.mass, s.fields["velocity"][1:count]) for s in (rollout, trajectory)]
    scale = max(float(np.ptp(values)) for values in theirs.values())
    total = np.sum(list(ours.values()), axis=0)
    drift = float(np.abs(total - total[0]).max()) / scale if "internal" in ours and scale > 0 else float("nan")
    ratio = float(ours["kinetic"][tail:].mean()) / max(float(theirs["kinetic"][tail:].mean()), 1e-30)
    ratio = float("inf") if np.isnan(ratio) else ratio
    return {
        "kinetic_ratio": ratio,
        "kinetic_factor": max(ratio, 1.0 / ratio) if ratio > 0 else float("inf"),
        "energy_drift": float("inf") if "internal" in ours and np.isnan(drift) else drift,
        "momentum_rrmse": _since(momentum[0], momentum[1], np.zeros(3)),
    }
