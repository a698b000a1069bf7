"""Abaqus beams published with the global TIGNN, as a data set of this program.

Source: github.com/quercushernandez/ThermodynamicsGNN, data/database_beam (GPL-3); Hernandez, Badias, Chinesta, Cueto,
"Thermodynamics-informed graph neural networks", IEEE TAI 2022. 52 quasi-static ramps of a line load on one
viscoelastic beam of 40 x 10 x 10 cm: 756 nodes, 20 steps of 0.05 s. Read from the original `beam_N.pt` or from an
HDF5 file with the same numbers.

**Which frame a load belongs to.** The files hold 21 states and 20 loads. The shear force in a section, summed
from the nodal stress of state t (beam_01, x = 8 cm), is 0, 30019, 60152, 90519 Pa cm2 for t = 0, 1, 2, 3, and the
loads f[0], f[1], f[2] are 30000, 60000, 90000: so f[t] is the load of state t + 1, the stress-free state 0 has
none, and the unit is Pa cm2 = 1e-4 N (beams end under 60 N). Hence `load[0] = 0` and `load[t + 1] = 1e-4 f[t]`.
All 46 ramps are linear, so the linear run of the load inside a step loses nothing. State 0 is undeformed
but moves already, at the constant speed of the ramp; the trapezoid rule links positions and velocities to 5e-4.
"""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Bool, Float, Int

from zsdt.errors import DataError
from zsdt.files import data_root
from zsdt.interop.pyg_pickle import Record, attributes, read_torch_file
from zsdt.trajectory import Body, DatasetEntry, Trajectory, write_index, write_trajectory

CENTIMETRE = 1e-2
PASCAL_SQUARE_CENTIMETRE = 1e-4  # N
FRAME_DT = 0.05
REGIME, FAMILY = "ramp", "abaqus"
VALIDATION = (1, 2, 6, 16, 17)  # the HDF5 file marks these; a folder of .pt files marks none


@dataclass
class AbaqusOptions:
    """Where the beams are and which of them test.

    path: folder with beam_1.pt ... beam_52.pt, or an HDF5 file; the file in the data folder if not given.
    test: numbers of the beams that are kept for the test.
    """

    path: str | None = None
    test: list[int] = field(default_factory=list)


@dataclass
class _RawBeam:
    """One beam in its own units: z [frames, nodes, 12] cm, cm/s, Pa; f [frames - 1, nodes, 3] Pa cm2."""

    number: int
    split: str
    z: Float[np.ndarray, "frames nodes 12"]
    f: Float[np.ndarray, "steps nodes 3"]
    edge_index: Int[np.ndarray, "2 edges"]
    is_free: Bool[np.ndarray, " nodes"]


def convert(options: AbaqusOptions, out: Path) -> dict[str, Any]:
    """Writes the beams as a data set (index.csv, trajectories/beam_NN.h5) below `out`; returns what it wrote.

    Raises: DataError where files are missing or broken or a test beam is not among them.
    """
    source = _source(options)
    numbers = _numbers(source)
    absent = sorted(set(options.test) - set(numbers))
    if absent:
        raise DataError(
            f"The test beams {', '.join(map(str, absent))} are not in {source}; "
            "choose among those that are there or point data.path at a folder that has them."
        )
    entries = []
    for number in numbers:
        beam = _read_beam(source, number)
        if number in options.test:
            beam.split = "test"
        name = f"beam_{number:02d}"
        file = f"trajectories/{name}.h5"
        write_trajectory(out / file, _trajectory_of(beam, name))
        entries.append(DatasetEntry(file=file, name=name, split=beam.split, regime=REGIME, family=FAMILY))
    write_index(out, entries)
    splits = {s: sum(e.split == s for e in entries) for s in ("train", "val", "test")}
    return {"trajectories": len(entries), "splits": splits, "source": source.name}


def source_files(options: AbaqusOptions) -> list[Path]:
    """The files that `convert` reads, for whoever wants to know whether they have changed.

    Raises: DataError where there are none.
    """
    source = _source(options)
    numbers = _numbers(source)
    return [source / f"beam_{number}.pt" for number in numbers] if source.is_dir() else [source]


def _source(options: AbaqusOptions) -> Path:
    return Path(options.path) if options.path else data_root() / "abaqus_beams" / "abaqus_beams_dev.h5"


def _numbers(source: Path) -> list[int]:
    """Numbers of the beams at `source`, ascending."""
    if source.is_dir():
        found = [re.fullmatch(r"beam_(\d+)\.pt", p.name) for p in source.iterdir()]
    elif source.is_file():
        with _open(source) as file:
            found = [re.fullmatch(r"beam_(\d+)", name) for name in file]
    else:
        raise DataError(f"There is nothing at {source}; set data.path to a folder of beam_N.pt files or an HDF5 file.")
    numbers = sorted(int(m.group(1)) for m in found if m)
    if not numbers:
        raise DataError(f"{source} holds no beams (beam_1.pt, beam_2.pt, ...); set data.path to a folder that does.")
    return numbers


def _open(source: Path) -> h5py.File:
    try:
        return h5py.File(source, "r")
    except OSError as error:
        raise DataError(f"{source} is not a readable HDF5 file ({error}); fetch it again.") from error


def _read_beam(source: Path, number: int) -> _RawBeam:
    return _read_pt(source / f"beam_{number}.pt", number) if source.is_dir() else _read_hdf5(source, number)


def _read_hdf5(source: Path, number: int) -> _RawBeam:
    with _open(source) as file:
        try:
            group = file[f"beam_{number:02d}"] if f"beam_{number:02d}" in file else file[f"beam_{number}"]
            return _RawBeam(
                number=number,
                split=str(group.attrs["split"]),
                z=group["z"][:].astype(np.float64),
                f=group["f"][:].astype(np.float64),
                edge_index=file["edge_index"][:].astype(np.int64),
                is_free=file["is_free"][:].astype(bool),
            )
        except (KeyError, OSError) as error:
            raise DataError(f"Beam {number} in {source} is incomplete ({error}); fetch the file again.") from error


def _read_pt(path: Path, number: int) -> _RawBeam:
    """One graph per step: x = state, y = next state, f = load of the next state, n = one-hot (free, clamped)."""
    content = read_torch_file(path)
    steps = content if isinstance(content, list) else []
    if not steps or not all(isinstance(s, Record) for s in steps):
        raise DataError(f"{path} does not hold a list of graphs; use the published files.")
    graphs = [attributes(s) for s in steps]
    missing = {"x", "y", "f", "n", "edge_index"} - set(graphs[0])
    if missing or not all(np.ndim(g.get("x", 0)) == 2 and g["x"].shape[1] == 12 for g in graphs):
        fault = f"no {', '.join(sorted(missing))}" if missing else "states without 12 columns"
        raise DataError(f"The graphs in {path} are not those of the beam ({fault}); use the published files.")
    for now, later in itertools.pairwise(graphs):
        if not np.array_equal(now["y"], later["x"]):
            raise DataError(f"The steps in {path} do not follow one another; use the published files.")
    return _RawBeam(
        number=number,
        split="val" if number in VALIDATION else "train",
        z=np.stack([g["x"] for g in graphs] + [graphs[-1]["y"]]).astype(np.float64),
        f=np.stack([g["f"] for g in graphs]).astype(np.float64),
        edge_index=graphs[0]["edge_index"].astype(np.int64),
        is_free=graphs[0]["n"][:, 0] == 1,
    )


def _trajectory_of(beam: _RawBeam, name: str) -> Trajectory:
    """SI units, undirected pairs, bricks, and the load at the frame that it belongs to (see above)."""
    z, frames = beam.z, len(beam.z)
    nodes = z.shape[1]
    if beam.f.shape != (frames - 1, nodes, 3) or len(beam.is_free) != nodes or beam.edge_index.max() >= nodes:
        raise DataError(f"{name}: states, loads, edges and node types do not fit together; fetch the file again.")
    points = z[0, :, :3] * CENTIMETRE
    pairs = np.unique(np.sort(beam.edge_index.T, axis=1), axis=0)
    pitch = float(np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1).min())
    load = np.zeros((frames, nodes, 3))
    load[1:] = beam.f * PASCAL_SQUARE_CENTIMETRE
    body = Body(
        points=points,
        pairs=pairs,
        cells=bricks_of(points, pitch),
        clamped=~beam.is_free,
        mass=np.zeros(nodes),
        gravity=np.zeros(3),
        frame_dt=FRAME_DT,
        pitch=round(pitch, 6),
    )
    return Trajectory(
        body=body,
        times=FRAME_DT * np.arange(frames),
        fields={
            "position": z[:, :, 0:3] * CENTIMETRE,
            "velocity": z[:, :, 3:6] * CENTIMETRE,
            "stress": z[:, :, 6:12],
        },
        load=load,
        meta={"name": name, "regime": REGIME, "family": FAMILY, "shape": np.ptp(points, axis=0).round(6).tolist()},
    )


def bricks_of(points: Float[np.ndarray, "nodes 3"], pitch: float) -> Int[np.ndarray, "cells 8"]:
    """Hexahedra (local node x + 2 y + 4 z) between nodes that sit on a grid of `pitch` [m]; none if they do not."""
    lattice = (points - points.min(axis=0)) / pitch
    places = np.rint(lattice).astype(np.int64)
    if np.abs(lattice - places).max() > 1e-3:
        return np.zeros((0, 8), np.int64)
    counts = places.max(axis=0) + 1
    node_at = np.full(counts, -1, np.int64)
    node_at[tuple(places.T)] = np.arange(len(points))
    nx, ny, nz = counts
    corners = [(a, b, c) for c in (0, 1) for b in (0, 1) for a in (0, 1)]
    cells = np.stack(
        [node_at[a : nx - 1 + a, b : ny - 1 + b, c : nz - 1 + c].transpose(2, 1, 0).ravel() for a, b, c in corners],
        axis=1,
    )
    return cells[(cells >= 0).all(axis=1)]
