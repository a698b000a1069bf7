"""A LagrangeBench folder (see `zsdt.interop.lagrangebench`) as a data set of ours.

Positions, particle types and times come over. Velocities are backward differences, as LagrangeBench takes them, unless
the file is an export of ours, which holds them. Walls become held nodes (`clamped`) whose positions are given frame by
frame. Mass, material and vessel are not in that layout, so a network or solver that needs them refuses these bodies;
lengths and times are the source's own units, most often without dimension.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Float

from zsdt.errors import DataError
from zsdt.fields import FIELDS
from zsdt.files import atomic_path
from zsdt.interop.lagrangebench import FILES, METADATA, MOVING_WALL, RIGID_BODY, SOLID_WALL
from zsdt.trajectory import Body, DatasetEntry, Trajectory, write_index, write_trajectory

NEEDED = ("dim", "dx", "dt", "write_every", "bounds", "periodic_boundary_conditions")
HELD = (SOLID_WALL, MOVING_WALL)


def import_lagrangebench(folder: str | os.PathLike[str], out: str | os.PathLike[str]) -> list[DatasetEntry]:
    """Writes a data set of ours in `out` from the LagrangeBench folder `folder`; returns its entries.

    A set of two dimensions lies in the plane z = 0.

    Raises: DataError where files or keys are missing, a box is periodic (neighbours across its border would be lost),
    particles are of a type that we do not have, or particles are not numbers.
    """
    folder = Path(folder)
    metadata = read_metadata(folder)
    entries = []
    with atomic_path(out) as beside:
        beside.mkdir()
        for split, theirs in FILES.items():
            path = folder / f"{theirs}.h5"
            if path.is_file():
                for trajectory, family in _trajectories(path, split, metadata):
                    entry = DatasetEntry(
                        f"trajectories/{trajectory.name}.h5",
                        trajectory.name,
                        split,
                        str(trajectory.meta["regime"]),
                        family,
                    )
                    write_trajectory(beside / entry.file, trajectory)
                    entries.append(entry)
        if not entries:
            raise DataError(f"{folder} holds none of train.h5, valid.h5 and test.h5; name a LagrangeBench folder.")
        write_index(beside, entries)
    return entries


def read_metadata(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """`metadata.json` of a LagrangeBench folder. Raises: DataError where it is missing or broken, or periodic."""
    path = Path(folder) / METADATA
    try:
        metadata = dict(json.loads(path.read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise DataError(f"{path} cannot be read ({error}); name a folder in the LagrangeBench layout.") from error
    if missing := [key for key in NEEDED if key not in metadata]:
        raise DataError(f"{path} does not say {', '.join(missing)}; a LagrangeBench data set has to.")
    if any(metadata["periodic_boundary_conditions"]):
        raise DataError(
            f"The box of {folder} is periodic, and our bodies have no neighbours across a border; import a data set "
            "with walls or a free surface, such as a dam break or a lid-driven cavity."
        )
    if metadata["dim"] not in (2, 3):
        raise DataError(f"{path} says dim = {metadata['dim']}, but bodies have two or three dimensions.")
    return metadata


def _trajectories(path: Path, split: str, metadata: dict[str, Any]):
    """The trajectories of a file one by one, with their families. Raises: DataError where the file is broken."""
    try:
        with h5py.File(path, "r") as file:
            for key, group in file.items():
                yield _trajectory(group, f"{split}_{key}", split, metadata, path)
    except (OSError, KeyError) as error:
        raise DataError(f"{path} is broken or not in the LagrangeBench layout ({error}); get it anew.") from error


def _trajectory(
    group: h5py.Group, name: str, split: str, metadata: dict[str, Any], path: Path
) -> tuple[Trajectory, str]:
    position, types = group["position"][:].astype(np.float64), group["particle_type"][:].astype(int)
    if position.ndim != 3 or position.shape[1:] != (len(types), metadata["dim"]) or len(position) < 2:
        raise DataError(
            f"{path}, trajectory {group.name}: position has the shape {position.shape}, but {len(types)} particles of "
            f"{metadata['dim']} dimensions over at least two frames were promised."
        )
    if not np.isfinite(position).all():
        raise DataError(f"{path}, trajectory {group.name}: some positions are not numbers; get the file anew.")
    if unknown := sorted(set(types) - {0, *HELD, RIGID_BODY}):
        raise DataError(f"{path}, trajectory {group.name}: particle type {unknown[0]} is not known here (0 to 3 are).")
    if (types == RIGID_BODY).any():
        raise DataError(
            f"{path}, trajectory {group.name}: rigid bodies (type 3) move as one, which our bodies have no words for; "
            "import a data set of fluids and walls."
        )
    frame_dt = float(metadata["dt"]) * int(metadata["write_every"])
    ours = group.get("zsdt")
    about = {k: v.item() if isinstance(v, np.generic) else v for k, v in ours.attrs.items()} if ours is not None else {}
    position = np.pad(position, ((0, 0), (0, 0), (0, 3 - metadata["dim"]))) * float(about.get("length", 1.0))
    case = str(metadata.get("case", "lagrangebench")).lower()
    body = Body(
        points=position[0],
        pairs=np.zeros((0, 2), np.int64),
        clamped=np.isin(types, HELD),
        mass=np.zeros(len(types)),
        frame_dt=frame_dt,
        pitch=float(about.get("pitch", metadata["dx"])),
        gravity=np.zeros(3),  # the layout knows how strong it is, not where it points
    )
    meta = {
        "name": str(about.get("name", name)),
        "regime": str(about.get("regime", case)),
        "source": "LagrangeBench",
        "case": case,
        "gravity_magnitude": metadata.get("g_ext_magnitude"),
        "viscosity": metadata.get("viscosity"),
    }
    fields = {"position": position, "velocity": _backward(position, frame_dt), **_kept(ours, len(types))}
    times = frame_dt * np.arange(len(position))
    trajectory = Trajectory(body, times, fields, np.zeros_like(position), meta=meta)
    return trajectory, str(about.get("family", case))


def _backward(position: Float[np.ndarray, "frames n 3"], frame_dt: float) -> Float[np.ndarray, "frames n 3"]:
    """Backward differences; the first frame has that of the second."""
    change = np.diff(position, axis=0) / frame_dt
    return np.concatenate([change[:1], change])


def _kept(ours: h5py.Group | None, particles: int) -> dict[str, Float[np.ndarray, "frames n _"]]:
    """Fields that an export of ours kept; zero at the particles of the wall, which it added."""
    if ours is None or "fields" not in ours:
        return {}
    found = {}
    for name, data in ours["fields"].items():
        if name in FIELDS:
            values = data[:].astype(np.float64)
            found[name] = np.pad(values, ((0, 0), (0, particles - values.shape[1]), (0, 0)))
    return found
