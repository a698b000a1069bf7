"""The VTKHDF file format (version 2.2): meshes whose points and fields move while their cells stay, in one file.

Written with h5py alone; ParaView (5.12 or newer) and VTK's `vtkHDFReader` open it. Specification:
docs.vtk.org, "VTKHDF file format". A file holds one partition. All steps share the cells (offset 0 in every step);
points and fields lie one step behind the other.
"""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import h5py
import numpy as np
from jaxtyping import Float, Int

from zsdt.errors import DataError
from zsdt.files import atomic_path

VERSION = (2, 2)
VERTEX, HEXAHEDRON = 1, 12  # VTK's numbers of cell types
# VTK orders the corners of a hexahedron around its faces; ours are x + 2 y + 4 z.
CORNERS = (0, 1, 3, 2, 4, 5, 7, 6)
_POLYGON_KINDS = ("Vertices", "Lines", "Strips", "Polygons")

Values = Float[np.ndarray, "frames rows components"] | Float[np.ndarray, "rows components"]


@dataclass
class MovingMesh:
    """A mesh over frames, to be written.

    times [frames] s; points [frames, nodes, 3] m; cells [cells, corners]: nodes in VTK's order, all of `cell_type`;
    point_data: name -> [frames, nodes, components], or [nodes, components] where it does not change; cell_data: the
    same of cells; frame_data: name -> [frames, components], numbers of the whole frame (field data); notes: name ->
    text, kept as attributes of the file, which VTK leaves alone.
    """

    times: Float[np.ndarray, " frames"]
    points: Float[np.ndarray, "frames nodes 3"]
    cells: Int[np.ndarray, "cells corners"]
    cell_type: int
    point_data: dict[str, Values] = field(default_factory=dict)
    cell_data: dict[str, Values] = field(default_factory=dict)
    frame_data: dict[str, Float[np.ndarray, "frames components"]] = field(default_factory=dict)
    notes: dict[str, str] = field(default_factory=dict)


def write_moving_mesh(path: str | os.PathLike[str], mesh: MovingMesh) -> None:
    """Writes an unstructured grid over frames; numbers as float32, times as float64.

    Raises: DataError where shapes do not fit together or the disk does not take the file.
    """
    frames, nodes = mesh.points.shape[:2]
    _check(mesh)
    content = io.BytesIO()  # in memory first: the HDF5 library crashes the process when a disk is full
    with h5py.File(content, "w") as file:
        file.attrs.update(mesh.notes)
        root = _root(file, "UnstructuredGrid")
        steps = root.create_group("Steps")
        steps.attrs["NSteps"] = frames
        steps["Values"] = mesh.times
        _counts(root, NumberOfPoints=nodes, NumberOfCells=len(mesh.cells), NumberOfConnectivityIds=mesh.cells.size)
        same = np.zeros(frames, np.int64)
        steps["PartOffsets"], steps["NumberOfParts"] = same, same + 1
        steps["PointOffsets"] = nodes * np.arange(frames)
        steps["CellOffsets"], steps["ConnectivityIdOffsets"] = same[:, None], same[:, None]
        _put(root, "Points", mesh.points, frames)
        _cells(root, mesh.cells)
        root["Types"] = np.full(len(mesh.cells), mesh.cell_type, np.uint8)
        for group, data in (("PointData", mesh.point_data), ("CellData", mesh.cell_data)):
            inside, offsets = root.create_group(group), steps.create_group(f"{group}Offsets")
            for name, values in data.items():
                moving = values.ndim == 3
                _put(inside, name, values, frames if moving else 1)
                offsets[name] = values.shape[-2] * np.arange(frames) if moving else same
        _frame_data(root, steps, mesh)
    with atomic_path(path) as beside:
        beside.write_bytes(content.getbuffer())


def write_surface(
    path: str | os.PathLike[str],
    points: Float[np.ndarray, "points 3"],
    polygons: Sequence[Int[np.ndarray, "_ _"]],
    notes: Mapping[str, str] | None = None,
) -> None:
    """Writes polygons (groups of faces with the same number of corners) that stand still, as PolyData.

    Raises: DataError where the disk does not take the file.
    """
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        file.attrs.update(notes or {})
        root = _root(file, "PolyData")
        _counts(root, NumberOfPoints=len(points))
        root["Points"] = np.asarray(points, np.float32)
        for kind in _POLYGON_KINDS:
            group = root.create_group(kind)
            faces = polygons if kind == "Polygons" else []
            sizes = [face for part in faces for face in [part.shape[1]] * len(part)]
            _counts(group, NumberOfCells=len(sizes), NumberOfConnectivityIds=int(sum(sizes)))
            group["Offsets"] = np.cumsum([0, *sizes])
            group["Connectivity"] = np.concatenate([part.ravel() for part in faces] or [np.zeros(0)]).astype(np.int64)
    with atomic_path(path) as beside:
        beside.write_bytes(content.getbuffer())


def _check(mesh: MovingMesh) -> None:
    frames, nodes, cells = *mesh.points.shape[:2], len(mesh.cells)
    for rows, data in ((nodes, mesh.point_data), (cells, mesh.cell_data)):
        for name, values in data.items():
            if values.shape[:-1] not in ((frames, rows), (rows,)):
                raise DataError(
                    f"The field {name} has the shape {values.shape}, but the mesh has {frames} frames of {rows} rows; "
                    "give one row per node or cell."
                )
    if len(mesh.times) != frames or any(len(v) != frames for v in mesh.frame_data.values()):
        raise DataError(f"The mesh has {frames} frames; times and frame data must have as many rows.")
    if cells and not 0 <= mesh.cells.min() <= mesh.cells.max() < nodes:
        raise DataError(f"A cell names a node that is not among the {nodes} nodes; check the cells.")


def _root(file: h5py.File, kind: str) -> h5py.Group:
    root = file.create_group("VTKHDF", track_order=True)
    root.attrs["Version"] = np.array(VERSION, np.int64)
    # The reader wants a text of fixed length, which h5py makes of bytes.
    root.attrs.create("Type", np.bytes_(kind), dtype=h5py.string_dtype("ascii", len(kind)))
    return root


def _counts(group: h5py.Group, **counts: int) -> None:
    for name, count in counts.items():
        group[name] = np.array([count], np.int64)


def _cells(root: h5py.Group, cells: Int[np.ndarray, "cells corners"]) -> None:
    root["Connectivity"] = cells.ravel().astype(np.int64)
    root["Offsets"] = cells.shape[1] * np.arange(len(cells) + 1)


def _put(group: h5py.Group, name: str, values: np.ndarray, frames: int) -> None:
    """Numbers of all frames one behind the other, a frame to a chunk."""
    width = values.shape[-1]
    flat = values.reshape(-1, width) if width > 1 else values.reshape(-1)
    chunk = (max(len(flat) // max(frames, 1), 1), *flat.shape[1:])
    packed = {"compression": "gzip", "compression_opts": 1, "chunks": chunk} if len(flat) else {}
    group.create_dataset(name, data=flat.astype(np.float32), **packed)


def _frame_data(root: h5py.Group, steps: h5py.Group, mesh: MovingMesh) -> None:
    """Numbers of the whole frame as field data."""
    frames = len(mesh.times)
    group, offsets = root.create_group("FieldData"), steps.create_group("FieldDataOffsets")
    sizes = steps.create_group("FieldDataSizes")
    for name, values in mesh.frame_data.items():
        group[name] = np.asarray(values, np.float64) if values.shape[1] > 1 else np.asarray(values[:, 0], np.float64)
        offsets[name] = np.arange(frames)
        sizes[name] = np.tile([values.shape[1], 1], (frames, 1))
