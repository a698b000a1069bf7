"""Trajectories, rollouts and twins as VTKHDF files for ParaView: one file for all frames of a body.

A solid becomes hexahedra, a liquid (or a body without cells) vertices; beside a liquid stands its vessel,
`<name>_vessel.vtkhdf`. Fields keep their names and SI units (`zsdt.fields`), with these additions:

- `displacement` [m] from the first frame, `von_mises` [Pa] of a solid, `speed` [m/s] of a liquid;
- `stress` in VTK's order of symmetric tensors, XX YY ZZ XY YZ XZ;
- cell data of a solid: `von_mises` [Pa] of the mean stress of the corners, energy densities [J/m3] as their mean, and
  `volume_ratio` [-], the cell's present volume over its stress-free one at the middle;
- a rollout beside its truth: `position_error` [m], `<field>_error`, vectors or tensors, prediction less truth;
- field data of each frame: the energy account [J].
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from zsdt.errors import DataError
from zsdt.evaluation.outline import shell
from zsdt.fields import von_mises
from zsdt.fluid.vessel import Vessel
from zsdt.interop.vtkhdf import CORNERS, HEXAHEDRON, VERTEX, MovingMesh, write_moving_mesh, write_surface
from zsdt.tignn.engine import Rollout
from zsdt.trajectory import Body, Trajectory

TENSOR_ORDER = (0, 1, 2, 3, 5, 4)  # ours is 11 22 33 12 13 23
DENSITIES = ("elastic_energy", "dissipated_energy")
SUFFIX = ".vtkhdf"
Fields = Mapping[str, Float[np.ndarray, "frames nodes components"]]


def write_trajectory_vtk(path: str | os.PathLike[str], trajectory: Trajectory) -> list[Path]:
    """Writes a trajectory to `path` (and its vessel beside it); returns the files. Raises: DataError (disk)."""
    mesh = mesh_of(trajectory.body, trajectory.times, trajectory.fields)
    if np.isfinite(trajectory.load).all():
        mesh.point_data["load"] = trajectory.load
    mesh.frame_data |= {f"{name}_J": values[:, None] for name, values in trajectory.ledger.items()}
    for name, values in trajectory.meta.get("frame_data", {}).items():  # what a twin adds frame by frame
        mesh.frame_data[name] = np.asarray(values, float).reshape(trajectory.frames, -1)
    mesh.notes["trajectory"] = trajectory.name
    return _write(path, mesh, trajectory.body)


def write_rollout_vtk(path: str | os.PathLike[str], trajectory: Trajectory, rollout: Rollout) -> list[Path]:
    """Writes what an engine predicted, with its errors against the trajectory, up to where it diverged.

    Returns the files. Raises: DataError where not one frame was predicted, or the disk does not take the file.
    """
    count = len(rollout.fields["position"]) if rollout.diverged_at is None else rollout.diverged_at
    if count < 2:
        raise DataError(f"{rollout.name} predicted no frame of {trajectory.name}; there is nothing to write.")
    predicted = {name: values[:count] for name, values in rollout.fields.items()}
    mesh = mesh_of(trajectory.body, trajectory.times[:count], predicted)
    for name, values in predicted.items():
        if name in trajectory.fields:
            gap = values - trajectory.fields[name][:count]
            mesh.point_data[f"{name}_error"] = gap[..., TENSOR_ORDER] if gap.shape[2] == 6 else gap
    mesh.point_data["load"] = trajectory.load[:count]
    mesh.frame_data |= {f"{name}_J": values[:count, None] for name, values in rollout.account.items()}
    mesh.notes |= {"trajectory": trajectory.name, "engine": rollout.name}
    return _write(path, mesh, trajectory.body)


def _write(path: str | os.PathLike[str], mesh: MovingMesh, body: Body) -> list[Path]:
    path = Path(path)
    write_moving_mesh(path, mesh)
    if body.vessel is None:
        return [path]
    beside = path.with_name(f"{path.name.removesuffix(SUFFIX)}_vessel{SUFFIX}")
    points, polygons = vessel_surface(Vessel(body.vessel))
    write_surface(beside, points, polygons, {"vessel": body.vessel.family.value})
    return [path, beside]


def mesh_of(body: Body, times: Float[np.ndarray, " frames"], fields: Fields) -> MovingMesh:
    """A body and its fields over frames as a mesh (see the top of this file)."""
    position = fields["position"]
    solid = len(body.cells) > 0
    cells = body.cells[:, CORNERS] if solid else np.arange(body.nodes)[:, None]
    mesh = MovingMesh(times, position, cells, HEXAHEDRON if solid else VERTEX)
    mesh.point_data["displacement"] = position - position[0]
    for name, values in fields.items():
        if name != "position":
            mesh.point_data[name] = values[..., TENSOR_ORDER] if values.shape[2] == 6 else values
    if "stress" in fields:
        mesh.point_data["von_mises"] = von_mises(fields["stress"])[..., None]
    elif "velocity" in fields:
        mesh.point_data["speed"] = np.linalg.norm(fields["velocity"], axis=2, keepdims=True)
    if body.clamped.any():
        mesh.point_data["clamped"] = body.clamped[:, None].astype(float)
    if solid:
        mesh.cell_data = cell_data(body, fields)
    return mesh


def cell_data(body: Body, fields: Fields) -> dict[str, Float[np.ndarray, "frames cells 1"]]:
    """Fields of the cells of a solid (see the top of this file)."""
    found = {"volume_ratio": _middle_volume(fields["position"], body.cells) / _middle_volume(body.points, body.cells)}
    found = {name: values[..., None] for name, values in found.items()}
    if "stress" in fields:
        found["von_mises"] = von_mises(fields["stress"][:, body.cells].mean(axis=2))[..., None]
    for name in DENSITIES:
        if name in fields:
            found[name] = fields[name][:, body.cells].mean(axis=2)
    return found


def _middle_volume(
    points: Float[np.ndarray, "*frames nodes 3"], cells: Int[np.ndarray, "cells 8"]
) -> Float[np.ndarray, "*frames cells"]:
    """Determinant of the edges through the middle of every cell [m3]."""
    corners = points[..., cells, :]
    signs = np.array([[(k >> axis & 1) * 2 - 1 for k in range(8)] for axis in range(3)]) / 4.0
    return np.linalg.det(np.einsum("ak,...cki->...cai", signs, corners))


def vessel_surface(
    vessel: Vessel, rings: int = 40, angles: int = 64
) -> tuple[Float[np.ndarray, "points 3"], list[Int[np.ndarray, "_ _"]]]:
    """The inner wall of a vessel as quadrangles and its floor as one polygon, all seen from inside; points [m]."""
    points = shell(vessel, rings, angles).reshape(-1, 3)
    start, turn = np.arange(rings - 1)[:, None] * angles, np.arange(angles)
    beside = (turn + 1) % angles
    wall = np.stack([start + turn, start + turn + angles, start + beside + angles, start + beside], axis=-1)
    return points, [wall.reshape(-1, 4), turn[None]]
