"""A body, what happened to it over time, and the HDF5 file that keeps both.

One trajectory is one file. Every array carries its unit and a description as attributes, so that h5py alone is
enough to read it (layout in `write_trajectory`).
"""

from __future__ import annotations

import csv
import io
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from jaxtyping import Bool, Float, Int

from zsdt.errors import DataError
from zsdt.fields import FIELDS
from zsdt.files import atomic_path
from zsdt.scene import Foam, Liquid, Modulus, VesselFamily, VesselShape

SCHEMA = "zsdt.trajectory"
SCHEMA_VERSION = 2
READABLE = (1, 2)  # version 2 adds liquids: vessel, motion; what version 1 holds is the same


@dataclass
class VesselMotion:
    """How a vessel moved until the first frame, in which it stands still.

    times [samples] s before the first frame, rising to 0; velocity [samples, 3] m/s of the vessel in the room;
    gravity [samples, 3] m/s2 in the axes of the vessel, which turn when it tilts.
    """

    times: Float[np.ndarray, " samples"]
    velocity: Float[np.ndarray, "samples 3"]
    gravity: Float[np.ndarray, "samples 3"]


@dataclass
class Body:
    """All that does not change while a body moves: what an engine may know before the first frame.

    points [nodes, 3] m: stress-free reference positions; of a liquid those at the first frame. pairs [pairs, 2]:
    undirected edges, i < j; none for a liquid, whose neighbours change. cells [cells, 8]: hexahedra (local node
    x + 2 y + 4 z), empty where a data set has none. clamped [nodes]: nodes held by the clamp. mass [nodes] kg (zeros
    where unknown). material: the foam, liquid: the liquid; None where unknown or of the other kind. gravity [3] m/s2,
    frame_dt [s] between frames, pitch [m] of the grid, of a liquid its particle spacing (cube root of the volume of a
    particle). vessel, motion: of a liquid, whose coordinates are those of the vessel.
    """

    points: Float[np.ndarray, "nodes 3"]
    pairs: Int[np.ndarray, "pairs 2"]
    clamped: Bool[np.ndarray, " nodes"]
    mass: Float[np.ndarray, " nodes"]
    frame_dt: float
    pitch: float
    gravity: Float[np.ndarray, "3"] = field(default_factory=lambda: np.array([0.0, 0.0, -9.81]))
    cells: Int[np.ndarray, "cells 8"] = field(default_factory=lambda: np.zeros((0, 8), np.int64))
    material: Foam | None = None
    liquid: Liquid | None = None
    vessel: VesselShape | None = None
    motion: VesselMotion | None = None

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        return len(self.points)


@dataclass
class Trajectory:
    """A body and its fields over frames.

    times [frames] s; fields: name -> [frames, nodes, components] (see `zsdt.fields`); load [frames, nodes, 3] N:
    external nodal force at each frame, gravity not included (of a liquid the inertial force where its vessel is
    accelerated); ledger: name -> [frames] J, the energy account of
    whoever made the data; meta: anything that fits JSON (name, regime, shape, load history, seed).
    """

    body: Body
    times: Float[np.ndarray, " frames"]
    fields: dict[str, Float[np.ndarray, "frames nodes components"]]
    load: Float[np.ndarray, "frames nodes 3"]
    ledger: dict[str, Float[np.ndarray, " frames"]] = field(default_factory=dict)
    meta: dict[str, Any] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        """Number of frames, the first included."""
        return len(self.times)

    @property
    def name(self) -> str:
        """Name of the trajectory, unique in its data set."""
        return str(self.meta.get("name", "unnamed"))

    def at(self, frame: int) -> dict[str, Float[np.ndarray, "nodes components"]]:
        """All fields of one frame: name -> [nodes, components]."""
        return {name: values[frame] for name, values in self.fields.items()}


def write_trajectory(path: str | os.PathLike[str], trajectory: Trajectory) -> None:
    """Writes one HDF5 file, beside and then moved into place.

    Layout: attributes `schema`, `schema_version`, `meta` (JSON); groups `body`, `fields` (float32), `ledger`
    (float64); datasets `times` and `load`. Every dataset has the attributes `unit` and `description`.

    Raises: DataError where the disk does not take it.
    """
    body = trajectory.body
    content = io.BytesIO()  # in memory first: the HDF5 library crashes the process when a disk is full
    with h5py.File(content, "w") as file:
        file.attrs.update(schema=SCHEMA, schema_version=SCHEMA_VERSION, meta=json.dumps(trajectory.meta))

        def put(name: str, values: np.ndarray, unit: str, description: str) -> None:
            packed = values.ndim > 1
            data = file.create_dataset(
                name,
                data=values,
                compression="gzip" if packed else None,
                compression_opts=1 if packed else None,
            )
            data.attrs.update(unit=unit, description=description)

        put("times", trajectory.times, "s", "time of each frame")
        put("load", trajectory.load.astype(np.float32), "N", FIELDS["load"].description)
        put("body/points", body.points, "m", "stress-free reference positions")
        put("body/pairs", body.pairs.astype(np.int32), "1", "undirected edges, lower node first")
        put("body/cells", body.cells.astype(np.int32), "1", "hexahedra, local node x + 2 y + 4 z")
        put("body/clamped", body.clamped, "1", "true where the clamp holds a node")
        put("body/mass", body.mass, "kg", "lumped mass of a node")
        put("body/gravity", body.gravity, "m/s2", "gravity")
        file["body"].attrs.update(frame_dt=body.frame_dt, pitch=body.pitch)
        if body.material is not None:
            file["body"].attrs["material"] = _card(body.material)
        if body.liquid is not None:
            file["body"].attrs["liquid"] = _card(body.liquid)
        if body.vessel is not None:
            file["body"].attrs["vessel"] = _card(body.vessel)
        if body.motion is not None:
            put("body/motion/times", body.motion.times, "s", "times before the first frame")
            put("body/motion/velocity", body.motion.velocity, "m/s", "velocity of the vessel in the room")
            put("body/motion/gravity", body.motion.gravity, "m/s2", "gravity in the axes of the vessel")
        for name, values in trajectory.fields.items():
            known = FIELDS[name]
            put(f"fields/{name}", values.astype(np.float32), known.unit, known.description)
        for name, values in trajectory.ledger.items():
            put(f"ledger/{name}", values, "J", f"energy account: {name}")
    with atomic_path(path) as beside:
        beside.write_bytes(content.getbuffer())


def _card(thing: Foam | Liquid | VesselShape) -> str:
    """A dataclass of plain values and enums as JSON."""
    return json.dumps({name: getattr(value, "value", value) for name, value in vars(thing).items()})


def read_trajectory(path: str | os.PathLike[str]) -> Trajectory:
    """Reads what `write_trajectory` wrote; arrays come back as float64 where they are real.

    Raises: DataError where the file is missing, truncated, or of another schema.
    """
    if not Path(path).is_file():
        raise DataError(f"There is no trajectory file {path}; run the stage that makes it or correct the path.")
    try:
        with h5py.File(path, "r") as file:
            return _read_open_file(file, path)
    except (OSError, KeyError, RuntimeError) as error:
        raise DataError(
            f"The trajectory file {path} is broken or truncated ({error}); delete it and make it again."
        ) from error


def _read_open_file(file: h5py.File, path: str | os.PathLike[str]) -> Trajectory:
    found = (file.attrs.get("schema"), file.attrs.get("schema_version"))
    if found[0] != SCHEMA or found[1] not in READABLE:
        raise DataError(
            f"{path} follows schema {found[0]} version {found[1]}, but this program reads {SCHEMA} versions "
            f"{' and '.join(map(str, READABLE))}; convert it with the version of zsdt that wrote it or make it again."
        )
    group = file["body"]
    material = vessel = motion = None
    if "material" in group.attrs:
        card = json.loads(group.attrs["material"])
        material = Foam(**{**card, "modulus": Modulus(card["modulus"])})
    if "vessel" in group.attrs:
        card = json.loads(group.attrs["vessel"])
        vessel = VesselShape(**{**card, "family": VesselFamily(card["family"])})
    if "motion" in group:
        motion = VesselMotion(**{name: data[:].astype(np.float64) for name, data in group["motion"].items()})
    body = Body(
        points=group["points"][:].astype(np.float64),
        pairs=group["pairs"][:].astype(np.int64),
        cells=group["cells"][:].astype(np.int64),
        clamped=group["clamped"][:].astype(bool),
        mass=group["mass"][:].astype(np.float64),
        gravity=group["gravity"][:].astype(np.float64),
        frame_dt=float(group.attrs["frame_dt"]),
        pitch=float(group.attrs["pitch"]),
        material=material,
        liquid=Liquid(**json.loads(group.attrs["liquid"])) if "liquid" in group.attrs else None,
        vessel=vessel,
        motion=motion,
    )
    return Trajectory(
        body=body,
        times=file["times"][:].astype(np.float64),
        load=file["load"][:].astype(np.float64),
        fields={name: data[:].astype(np.float64) for name, data in file["fields"].items()},
        ledger={name: data[:].astype(np.float64) for name, data in file.get("ledger", {}).items()},
        meta=json.loads(file.attrs["meta"]),
    )


@dataclass(frozen=True)
class DatasetEntry:
    """One trajectory of a data set: file below the folder, name, split, regime and family."""

    file: str
    name: str
    split: str
    regime: str
    family: str


class Dataset:
    """A folder with `index.csv` (file, name, split, regime, family) and the trajectories that it names.

    Splits: train, val, test (held-out sizes inside the range of training), beyond (outside of it).

    Raises: DataError where the folder or its index is missing.
    """

    def __init__(self, folder: str | os.PathLike[str]):
        self.folder = Path(folder)
        index = self.folder / "index.csv"
        if not index.is_file():
            raise DataError(f"{folder} holds no data set (index.csv is missing); run the stage that makes it first.")
        with index.open(newline="") as lines:
            self.entries = [DatasetEntry(**row) for row in csv.DictReader(lines)]

    def split(self, *names: str, regime: str | None = None) -> list[DatasetEntry]:
        """Entries of the named splits, in the order of the index; only those of one regime if it is given."""
        return [e for e in self.entries if e.split in names and regime in (None, e.regime)]

    def read(self, entry: DatasetEntry) -> Trajectory:
        """The trajectory of an entry (see `read_trajectory`)."""
        return read_trajectory(self.folder / entry.file)


def write_index(folder: str | os.PathLike[str], entries: list[DatasetEntry]) -> None:
    """Writes `index.csv` of a data set folder."""
    columns = list(DatasetEntry.__dataclass_fields__)
    with atomic_path(Path(folder) / "index.csv") as beside, beside.open("w", newline="") as lines:
        writer = csv.DictWriter(lines, columns)
        writer.writeheader()
        writer.writerows({c: getattr(e, c) for c in columns} for e in entries)
