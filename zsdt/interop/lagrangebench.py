"""Data sets in the HDF5 layout of LagrangeBench (Toshev et al. 2023), which its loader `H5Dataset` reads.

A folder holds `train.h5`, `valid.h5`, `test.h5` and `metadata.json`. In each file a group `00000`, `00001`, ... is a
trajectory: `position` [frames, particles, dim] float32 and `particle_type` [particles] (0 fluid, 1 solid wall, 2 moving
wall, 3 rigid body). All trajectories of a file have the same number of frames. `metadata.json` names dt, dx, bounds and
the mean and spread of velocity (change of position a frame) and acceleration (change of that) over the fluid.

What that layout has no place for is kept in our own groups, which the loader never opens: `00000/zsdt/fields/*` and
attributes of `00000/zsdt`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Float, Int

from zsdt.errors import DataError, OptionError
from zsdt.fields import FIELDS
from zsdt.files import atomic_path
from zsdt.fluid.vessel import Vessel
from zsdt.tignn.liquid_body import wall_nodes
from zsdt.trajectory import Body, Dataset, DatasetEntry, Trajectory

FLUID, SOLID_WALL, MOVING_WALL, RIGID_BODY = range(4)
FILES = {"train": "train", "val": "valid", "test": "test"}  # ours -> theirs
METADATA = "metadata.json"
REACH = 1.45  # spacings: radius of the graph that their own generator writes
MARGIN = 2.0  # spacings between the particles and the bounds
SPREAD = 2.0  # largest factor between the spacings of one data set


class Unit(Enum):
    """Unit of length in the files: the metre, or the particle spacing of each trajectory (1 for all, as in a graph that
    is made with one radius for all)."""

    metre = "metre"
    spacing = "spacing"


@dataclass
class LagrangeBenchOptions:
    """walls: liquids get particles on the wall of their vessel, up to `rim` (above the highest particle) [spacings].
    regime: only trajectories of this regime; None for all. unit: of length."""

    walls: bool = True
    rim: float = 3.0
    regime: str | None = None
    unit: Unit = Unit.metre

    def __post_init__(self) -> None:
        if self.rim < 0:
            raise OptionError(f"rim = {self.rim} spacings above the liquid must not be negative.")


@dataclass
class _Moments:
    """Mean and mean square of changes a frame, a trajectory at a time, as their generator takes them."""

    means: list[np.ndarray] = field(default_factory=list)
    squares: list[np.ndarray] = field(default_factory=list)

    def add(self, changes: Float[np.ndarray, "frames particles dim"]) -> None:
        """Adds a trajectory."""
        self.means.append(changes.mean((0, 1)))
        self.squares.append(np.square(changes).mean((0, 1)))

    def mean_and_std(self) -> tuple[list[float], list[float]]:
        """Mean and standard deviation of each component; a spread of zero becomes 1, as theirs does."""
        mean = np.mean(self.means, axis=0)
        spread = np.sqrt(np.maximum(np.mean(self.squares, axis=0) - mean**2, 0.0))
        return mean.tolist(), np.where(spread < 1e-7, 1.0, spread).tolist()


def export_lagrangebench(
    folder: str | os.PathLike[str], out: str | os.PathLike[str], options: LagrangeBenchOptions | None = None
) -> dict[str, Any]:
    """Writes the splits train, val and test of the data set in `folder` as a LagrangeBench folder `out`.

    Positions are shifted so that the box of the whole set begins at 0. Free nodes of a solid are of the type 0 (their
    networks move only these), clamped ones of the type 1. Returns the metadata.

    Raises: DataError where there is no data set, nothing to write, or trajectories that do not share frames, frame
    time or (to a factor of 2) spacing.
    """
    options = options or LagrangeBenchOptions()
    data, out = Dataset(folder), Path(out)
    chosen = {split: data.split(split, regime=options.regime) for split in FILES}
    entries = [entry for split in chosen.values() for entry in split]
    if not chosen["train"]:
        raise DataError(f"{folder} has no train trajectories{_of(options)}; LagrangeBench cannot train on the rest.")
    survey = _survey(data, entries, options)
    with atomic_path(out) as beside:
        beside.mkdir()
        velocity, acceleration = _Moments(), _Moments()
        for split, split_entries in chosen.items():
            if split_entries:
                with h5py.File(beside / f"{FILES[split]}.h5", "w") as file:
                    for number, entry in enumerate(split_entries):
                        group = file.create_group(f"{number:05d}")
                        moved = _put(group, data.read(entry), entry, survey.low, options)
                        velocity.add(np.diff(moved, axis=0))
                        acceleration.add(np.diff(moved, n=2, axis=0))
        metadata = survey.metadata({split: len(found) for split, found in chosen.items()})
        for name, moments in (("vel", velocity), ("acc", acceleration)):
            metadata[f"{name}_mean"], metadata[f"{name}_std"] = moments.mean_and_std()
        (beside / METADATA).write_text(json.dumps(metadata, indent=1))
    return metadata


def _of(options: LagrangeBenchOptions) -> str:
    return f" of the regime '{options.regime}'" if options.regime else ""


@dataclass
class _Survey:
    """What all trajectories have in common, and the box around them, in the unit of the files; viscosity and gravity
    are means where that unit is the spacing."""

    frames: int
    frame_dt: float
    spacings: tuple[float, float]
    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]
    most: int
    viscosity: float
    gravity: float
    case: str

    def metadata(self, counts: dict[str, int]) -> dict[str, Any]:
        """Their keys, and ours under `zsdt`; times s."""
        dx = self.spacings[1]
        return {
            "case": self.case,
            "solver": "zsdt",
            "density_evolution": False,
            "dim": 3,
            "dx": dx,
            "dt": self.frame_dt,
            "t_end": self.frame_dt * (self.frames - 1),
            "viscosity": self.viscosity,
            "p_bg_factor": 0.0,
            "g_ext_magnitude": self.gravity,
            "artificial_alpha": 0.0,
            "free_slip": False,
            "write_every": 1,
            "is_bc_trick": False,
            # One less than there are: the last frame is a target, as in their own data.
            "sequence_length_train": self.frames - 1,
            "num_trajs_train": counts["train"],
            "sequence_length_test": self.frames - 1,
            "num_trajs_test": counts["test"],
            "num_particles_max": self.most,
            "periodic_boundary_conditions": [False, False, False],
            "bounds": np.stack([np.zeros(3), self.high - self.low], axis=1).tolist(),
            "default_connectivity_radius": REACH * dx,
            "zsdt": {"shift": (-self.low).tolist(), "spacings": list(self.spacings), "num_trajs_valid": counts["val"]},
        }


def _survey(data: Dataset, entries: Iterable[DatasetEntry], options: LagrangeBenchOptions) -> _Survey:
    """Looks at all trajectories once. Raises: DataError where they do not fit together."""
    seen: list[tuple[int, float, float]] = []
    lengths: list[float] = []
    low, high, most = np.full(3, np.inf), np.full(3, -np.inf), 0
    for entry in entries:
        trajectory = data.read(entry)
        body = trajectory.body
        places, types = _particles(trajectory, options)
        lengths.append(_length(body, options))
        places = places / lengths[-1]
        low, high = np.minimum(low, places.min((0, 1))), np.maximum(high, places.max((0, 1)))
        seen.append((trajectory.frames, round(body.frame_dt, 9), round(body.pitch / lengths[-1], 12)))
        most = max(most, len(types))
    frames, steps, spacings = (sorted(set(column)) for column in zip(*seen, strict=True))
    if len(frames) > 1 or len(steps) > 1:
        raise DataError(
            f"LagrangeBench wants trajectories of one length and one frame time; here are {frames} frames and "
            f"{steps} s. Choose one regime (--regime NAME)."
        )
    if spacings[-1] > SPREAD * spacings[0]:
        raise DataError(
            f"LagrangeBench has one particle spacing for all; here are {spacings[0]:.4g} to {spacings[-1]:.4g} m. "
            "Measure lengths in spacings (--unit spacing), or make a data set with one spacing."
        )
    liquid, inverse = body.liquid, 1.0 / np.array(lengths)
    return _Survey(
        frames=frames[0],
        frame_dt=steps[0],
        spacings=(spacings[0], spacings[-1]),
        low=low - MARGIN * spacings[-1],
        high=high + MARGIN * spacings[-1],
        most=most,
        viscosity=0.0 if liquid is None else liquid.viscosity / liquid.density * float(np.square(inverse).mean()),
        gravity=float(np.linalg.norm(body.gravity) * inverse.mean()),
        case="BEAM" if liquid is None else "GLASS",
    )


def _length(body: Body, options: LagrangeBenchOptions) -> float:
    """The unit of length of a trajectory [m]."""
    return body.pitch if options.unit is Unit.spacing else 1.0


def _particles(
    trajectory: Trajectory, options: LagrangeBenchOptions
) -> tuple[Float[np.ndarray, "frames particles 3"], Int[np.ndarray, " particles"]]:
    """Positions [m] with those of the vessel's wall behind them, and the types."""
    body, places = trajectory.body, trajectory.fields["position"]
    types = np.where(body.clamped, SOLID_WALL, FLUID)
    if body.vessel is None or not options.walls:
        return places, types
    vessel = Vessel(body.vessel)
    top = min(vessel.rim, float(places[..., 2].max()) + options.rim * body.pitch)
    wall = wall_nodes(vessel, body.pitch, top)
    still = np.broadcast_to(wall, (len(places), *wall.shape))
    return np.concatenate([places, still], axis=1), np.concatenate([types, np.full(len(wall), SOLID_WALL)])


def _put(
    group: h5py.Group,
    trajectory: Trajectory,
    entry: DatasetEntry,
    low: Float[np.ndarray, "3"],
    options: LagrangeBenchOptions,
) -> Float[np.ndarray, "frames fluids 3"]:
    """Writes one trajectory; returns the positions of what moves, as they are in the file."""
    places, types = _particles(trajectory, options)
    length = _length(trajectory.body, options)
    shifted = (places / length - low).astype(np.float32)
    group.create_dataset("particle_type", data=types.astype(np.int32))
    group.create_dataset("position", data=shifted, compression="gzip", compression_opts=1)
    ours = group.create_group("zsdt")
    ours.attrs.update(name=entry.name, split=entry.split, regime=entry.regime, family=entry.family)
    ours.attrs.update(pitch=trajectory.body.pitch, length=length, nodes=trajectory.body.nodes)
    for name, values in trajectory.fields.items():
        if name != "position":
            kept = ours.create_dataset(f"fields/{name}", data=values.astype(np.float32), compression="gzip")
            kept.attrs["unit"] = FIELDS[name].unit
    return shifted[:, types == FLUID].astype(np.float64)
