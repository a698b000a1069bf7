"""The states of a twin as a trajectory file, so that whatever reads trajectories reads a twin as well.

The load that a twin estimates is a sum, not one of every node, so the trajectory's load is unknown (NaN). What a
twin knows frame by frame besides (estimated load, innovation, whether it was predicted on) is in `meta["frame_data"]`,
name -> [frames] or [frames, components], null where there is none.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from zsdt.fields import FIELDS
from zsdt.trajectory import Body, Trajectory, write_trajectory
from zsdt.twin.glass_log import GLASS_FAULTS, GlassTwinLog
from zsdt.twin.twin_log import FAULTS, TwinLog

TWIN_STATES = "twin.h5"  # beside the recording


def write_states(path: str | os.PathLike[str], log: TwinLog | GlassTwinLog) -> None:
    """Writes the states of a run (see `zsdt.trajectory.write_trajectory`). Raises: DataError (disk)."""
    write_trajectory(path, states_of(log) if isinstance(log, TwinLog) else glass_states_of(log))


def states_of(log: TwinLog) -> Trajectory:
    """A beam twin: body with the calibrated material, positions and decoded fields, energy account."""
    faults = {fault.value for fault in FAULTS}
    frame_data = {
        "estimated_load_N": log.load,
        "innovation_rms_m": _rms(log.innovation),
        "seen_nodes": log.seen.sum(axis=1),
        "predicted_on": np.array([status in faults for status in log.status]),
    }
    meta = {"stiffness": log.stiffness, "density": log.density}
    return _trajectory(
        log.name, log.mode, log.body, log.times, log.positions, log.fields, log.account, frame_data, meta
    )


def glass_states_of(log: GlassTwinLog) -> Trajectory:
    """A glass twin from t0 on, in the axes of the vessel."""
    faults = {fault.value for fault in GLASS_FAULTS}
    account = {name: values for name, values in log.account.items() if name != "volume"}
    frame_data = {
        "vessel_place_m": log.origin[log.start :],
        "innovation_rms_m": _rms(log.innovation),
        "viscosity_over_told": log.viscosity,
        "volume_below_surface_m3": log.volume,
        "predicted_on": np.array([status in faults for status in log.status[log.start :]]),
    }
    times = log.times[log.start :]
    return _trajectory(log.name, log.mode, log.body, times, log.positions, log.fields, account, frame_data, {})


def _trajectory(
    name: str,
    mode: str,
    body: Body,
    times: Float[np.ndarray, " frames"],
    positions: Float[np.ndarray, "frames nodes 3"],
    fields: dict[str, Float[np.ndarray, "frames nodes _"]],
    account: dict[str, Float[np.ndarray, " frames"]],
    frame_data: dict[str, np.ndarray],
    meta: dict[str, Any],
) -> Trajectory:
    known = {field: values for field, values in fields.items() if field in FIELDS and field != "position"}
    numbers = {key: _plain(np.asarray(values, float)) for key, values in frame_data.items()}
    source = "/".join(Path(name).parts[-2:])  # the rest of a path means nothing elsewhere
    about = {"name": f"twin_{mode}", "source": source, "regime": f"twin, {mode} loop", **meta, "frame_data": numbers}
    unknown = np.full(positions.shape, np.nan)
    return Trajectory(body, np.asarray(times), {"position": positions, **known}, unknown, dict(account), about)


def _rms(distance: Float[np.ndarray, "frames points"]) -> Float[np.ndarray, " frames"]:
    """Root mean square over what was seen; NaN where nothing was."""
    seen = np.isfinite(distance)
    square = np.where(seen, distance, 0.0) ** 2
    count = seen.sum(axis=1)
    return np.where(count > 0, np.sqrt(square.sum(axis=1) / np.maximum(count, 1)), np.nan)


def _plain(values: np.ndarray) -> Any:
    """Lists of numbers, None for NaN: what JSON knows."""
    mixed = values.astype(object)
    mixed[~np.isfinite(values)] = None
    return mixed.tolist()
