"""Exports of finished runs, each opened again by the program that it is for; tables and a picture of what it found.

`export_report` writes `export.md`, `export_onnx.csv`, `export_vtk.csv` and `export.png`. Needs the optional packages
onnx, onnxscript, onnxruntime and vtk.
"""

from __future__ import annotations

import importlib
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zsdt.errors import DataError, OptionError
from zsdt.evaluation.tables import write_csv
from zsdt.evaluation.vtk_picture import Shot, draw
from zsdt.files import atomic_path
from zsdt.interop.lagrangebench import LagrangeBenchOptions, Unit, export_lagrangebench
from zsdt.interop.lagrangebench_import import import_lagrangebench
from zsdt.interop.onnx_engine import load_onnx_engine
from zsdt.interop.onnx_export import COMPILED, SEED, export_onnx
from zsdt.interop.onnx_files import TOLERANCE
from zsdt.interop.vtk_export import SUFFIX, write_rollout_vtk
from zsdt.shipped import shipped
from zsdt.tignn.engine import Engine, load_engine, roll_out
from zsdt.trajectory import Dataset, Trajectory

FRAMES = 40  # of a rollout that checks
SCENES = ("foam_beam", "glycerin_glass")
SHOWN = (0.0, 0.4, 1.0)  # share of the drawn part of a rollout
DRAWN = {"foam_beam": 1.0, "glycerin_glass": 0.5}  # share of the rollout: a liquid is calm in the second half


@dataclass(frozen=True)
class Source:
    """Weights to export: label, folder, and the data set on which they can be rolled out."""

    label: str
    folder: Path
    dataset: Path | None = None


def export_report(
    outputs: str | os.PathLike[str],
    out: str | os.PathLike[str],
    scratch: str | os.PathLike[str],
    origin: str,
    say: Callable[[str], None] = lambda line: None,
) -> Path:
    """Exports what the runs below `outputs` have left into `scratch` and writes the page into `out`; returns it.

    origin: which command made it, where. Raises: DataError where no run has left data or networks; OptionError where an
    optional package is missing.
    """
    out, scratch, shelves = Path(out), Path(scratch), Path(outputs) / "artifacts"
    datasets = datasets_of(shelves)
    networks = [onnx_row(source, scratch, say) for source in sources_of(shelves)]
    files, shots = [], []
    for scene in SCENES:
        if scene in datasets:
            row, shot = vtk_row(scene, datasets[scene], scratch, say)
            files.append(row)
            shots.append(shot)
    if not files:
        raise DataError(
            f"No run below {outputs} has made data with `synthesize`; run `make sweep` or `make demo` first."
        )
    benches = [bench_row(scene, folder, scratch, say) for scene, folder in datasets.items()]
    draw(out / "export.png", shots)
    write_csv(out / "export_onnx.csv", networks)
    write_csv(out / "export_vtk.csv", files)
    with atomic_path(out / "export.md") as beside:
        beside.write_text(_page(origin, networks, files, benches))
    return out / "export.md"


def _manifests(shelves: Path, stage: str) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Finished artifacts of a stage, the newest first."""
    found = sorted(shelves.glob(f"{stage}/*/manifest.json"), key=lambda path: path.stat().st_mtime, reverse=True)
    yield from ((path.parent, json.loads(path.read_text())) for path in found)


def datasets_of(shelves: Path) -> dict[str, Path]:
    """The newest synthesized data set with test trajectories of each scene."""
    found: dict[str, Path] = {}
    for folder, _ in _manifests(shelves, "synthesize"):
        data = Dataset(folder)
        if tests := data.split("test"):
            scene = SCENES[0] if data.read(tests[0]).body.liquid is None else SCENES[1]
            found.setdefault(scene, folder)
    return {scene: found[scene] for scene in SCENES if scene in found}


def sources_of(shelves: Path) -> list[Source]:
    """Shipped segmentation and Psi_ini, and of the runs the newest node form of each data set and bracket."""
    parts = [(scene, part) for scene in SCENES for part in ("vision", "psi_ini")]
    found = {f"{scene}, {part}": Source(f"{scene}, {part}, shipped", shipped(scene, part)) for scene, part in parts}
    for folder, manifest in _manifests(shelves, "train_tignn"):
        card = json.loads((folder / "engine.json").read_text())
        held = [path for path in shelves.glob(f"*/{manifest['inputs'].get('dataset')}") if path.is_dir()]
        if card["kind"] not in {*COMPILED, SEED} and held:
            label = f"{_kind_of(held[0])}, node form, {card['options']['bracket']}"
            found.setdefault(label, Source(label, folder, held[0]))
    return sorted(found.values(), key=lambda source: (source.dataset is not None, source.label))


def _kind_of(dataset: Path) -> str:
    """What the trajectories of a data set are."""
    if dataset.parent.name == "import_abaqus":
        return "Abaqus beams"
    data = Dataset(dataset)
    return "foam beams" if data.read(data.entries[0]).body.liquid is None else "glasses"


def onnx_row(source: Source, scratch: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """One network: size, largest differences to torch over the largest value, milliseconds a frame of both."""
    say(f"onnx: {source.label}")
    path = scratch / f"{source.label.replace(', ', '_').replace(' ', '_')}.onnx"
    trajectory = _held_out(source.dataset) if source.dataset is not None else None
    frames = min(FRAMES, trajectory.frames) if trajectory is not None else None
    report = export_onnx(source.folder, path, trajectory, frames)
    row: dict[str, Any] = {
        "network": source.label,
        "artifact": source.folder.name if source.dataset is not None else "",
        "kind": report.kind,
        "megabytes": report.size / 1e6,
        "one_call": max(report.call.values()),
    }
    if trajectory is not None:
        row |= {"body": report.trajectory, "nodes": trajectory.body.nodes, "frames": report.frames}
        row |= {f"rollout_{name}": value for name, value in report.rollout.items()}
        row |= _clocks({"torch": load_engine(source.folder), "onnx": load_onnx_engine(path)}, trajectory, frames)
    return row


def _clocks(
    engines: dict[str, Engine], trajectory: Trajectory, frames: int | None, rounds: int = 2
) -> dict[str, float]:
    """Median milliseconds a frame of engines that take turns, after a round to warm up."""
    found: dict[str, list[np.ndarray]] = {name: [] for name in engines}
    for _ in range(rounds):
        for name, engine in engines.items():
            found[name].append(roll_out(engine, trajectory, frames).milliseconds)
    return {f"ms_{name}": float(np.median(np.concatenate(times[1:]))) for name, times in found.items()}


def _held_out(dataset: Path) -> Trajectory:
    """The first held-out trajectory."""
    data = Dataset(dataset)
    return data.read((data.split("test") or data.split("val") or data.entries)[0])


def vtk_row(scene: str, dataset: Path, scratch: Path, say: Callable[[str], None]) -> tuple[dict[str, Any], Shot]:
    """A rollout of the shipped engine on the held-out body that moves most, read back by VTK; and how to draw it."""
    say(f"vtk: {scene}")
    data = Dataset(dataset)
    trajectory = max((data.read(entry) for entry in data.split("test")), key=_stroke)
    rollout = roll_out(load_engine(shipped(scene, "tignn")), trajectory)
    files = write_rollout_vtk(scratch / f"{scene}{SUFFIX}", trajectory, rollout)
    row: dict[str, Any] = {
        "scene": scene,
        "body": trajectory.name,
        "files": len(files),
        "megabytes": sum(path.stat().st_size for path in files) / 1e6,
        **read_back(files[0], rollout.fields["position"], rollout.fields["velocity"], trajectory.times),
    }
    last = (rollout.diverged_at or trajectory.frames) - 1
    frames = tuple(round(DRAWN[scene] * share * last) for share in SHOWN)
    if len(files) > 1:
        top = float(np.percentile(np.linalg.norm(rollout.fields["velocity"][: frames[1] + 1], axis=2), 98))
        particle, vessel = 0.5 * trajectory.body.pitch, files[1]
        return row, Shot(files[0], "speed", "speed [m/s]", (0.0, _round(top)), frames, particle, vessel)
    from zsdt.fields import von_mises

    top = float(np.percentile(von_mises(rollout.fields["stress"]), 98))
    return row, Shot(files[0], "von_mises", "von Mises stress [Pa]", (0.0, _round(top)), frames)


def _stroke(trajectory: Trajectory) -> float:
    """Largest displacement over the size of the body."""
    position = trajectory.fields["position"]
    return float(np.abs(position - position[0]).max() / np.ptp(trajectory.body.points, axis=0).max())


def _round(value: float) -> float:
    """One significant digit, upwards."""
    unit = 10.0 ** np.floor(np.log10(value))
    return float(np.ceil(value / unit) * unit)


def read_back(path: Path, position: np.ndarray, velocity: np.ndarray, times: np.ndarray) -> dict[str, Any]:
    """What VTK's reader finds in a file: counts, and the largest difference to what was written over the largest value.

    Raises: OptionError where vtk is not installed.
    """
    try:
        reader = importlib.import_module("vtkmodules.vtkIOHDF").vtkHDFReader()
        to_numpy = importlib.import_module("vtkmodules.util.numpy_support").vtk_to_numpy
    except ImportError as error:
        raise OptionError("Reading VTKHDF files back needs the package vtk: `pip install 'zsdt[vtk]'`.") from error
    reader.SetFileName(os.fspath(path))
    reader.UpdateInformation()
    information, key = reader.GetOutputInformation(0), reader.GetExecutive().TIME_STEPS()
    steps = [information.Get(key, k) for k in range(information.Length(key))]
    gaps = [float(np.abs(np.array(steps) - times[: len(steps)]).max())]
    for frame, time in enumerate(steps):
        reader.UpdateTimeStep(time)
        grid = reader.GetOutputDataObject(0)
        for found, true in (
            (grid.GetPoints().GetData(), position),
            (grid.GetPointData().GetArray("velocity"), velocity),
        ):
            gaps.append(float(np.abs(to_numpy(found) - true[frame]).max() / np.abs(true[: len(steps)]).max()))
    data = {"point": grid.GetPointData(), "cell": grid.GetCellData(), "frame": grid.GetFieldData()}
    counts = {f"{name}_arrays": arrays.GetNumberOfArrays() for name, arrays in data.items()}
    return {
        "frames": len(steps),
        "points": grid.GetNumberOfPoints(),
        "cells": grid.GetNumberOfCells(),
        **counts,
        "largest_difference": max(gaps),
    }


def bench_row(scene: str, dataset: Path, scratch: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """A data set in the LagrangeBench layout and back: how many trajectories, and how far positions are off [m]."""
    say(f"lagrangebench: {scene}")
    there, back = scratch / f"{scene}_lagrangebench", scratch / f"{scene}_back"
    regime = None if scene == SCENES[1] else Dataset(dataset).split("train")[0].regime
    metadata = export_lagrangebench(dataset, there, LagrangeBenchOptions(regime=regime, unit=Unit.spacing))
    import_lagrangebench(there, back)
    before, after = Dataset(dataset), Dataset(back)
    origins = {entry.name: entry for entry in before.entries}
    worst = 0.0
    for entry in after.split("test"):
        ours, theirs = before.read(origins[entry.name]), after.read(entry)
        moved = theirs.fields["position"][:, : ours.body.nodes]
        gap = (moved - moved[0, 0]) - (ours.fields["position"] - ours.fields["position"][0, 0])
        worst = max(worst, float(np.abs(gap).max()))
    return {
        "data set": f"{scene}{f', {regime}' if regime else ''}",
        "train": metadata["num_trajs_train"],
        "valid": metadata["zsdt"]["num_trajs_valid"],
        "test": metadata["num_trajs_test"],
        "frames": metadata["sequence_length_train"] + 1,
        "most particles": metadata["num_particles_max"],
        "largest difference, there and back [m]": f"{worst:.1e}",
    }


def _table(rows: list[dict[str, Any]]) -> str:
    columns = sorted(dict.fromkeys(key for row in rows for key in row), key=lambda name: name.startswith("ms_"))
    lines = ["| " + " | ".join(c.replace("_", " ") for c in columns) + " |", "|" + " --- |" * len(columns)]
    lines += ["| " + " | ".join(_cell(row.get(column, "")) for column in columns) + " |" for row in rows]
    return "\n".join(lines)


def _cell(value: Any) -> str:
    if not isinstance(value, float):
        return str(value)
    return f"{value:.1e}" if value < 1e-3 else f"{value:.3g}"


def _page(origin: str, networks: list[dict], files: list[dict], benches: list[dict]) -> str:
    shown = [{k: v for k, v in row.items() if k not in ("kind", "artifact")} for row in networks]
    return f"""# Exports, opened by the programs that they are for

{origin}

## ParaView

![VTKHDF files as VTK draws them: a foam beam and glycerin in its vessel, predicted by the shipped engines](export.png)

Predictions of the shipped engines on held-out bodies, from the files, drawn by VTK without a window. Largest
difference: what `vtkHDFReader` finds at every step (points, velocity, times) to what was written, over the largest
value; files hold single precision.

{_table(files)}

`python -m pipelines.export vtk SOURCE OUT`, where SOURCE is a data set, a trajectory file, an evaluation or a twin
below `outputs/artifacts`; `--engine FOLDER` writes what that engine predicts, with its errors as fields.

## ONNX

Largest difference between ONNX Runtime and torch over the largest value of a field (positions: over the largest
displacement), in one call on random inputs of other sizes than the traced one, and over whole rollouts; asked:
{TOLERANCE:g}. Milliseconds a frame are medians of rollouts that take turns in one process, one thread; torch has the
compiled loops of zsdt.

{_table(shown)}

`python -m pipelines.export onnx WEIGHTS OUT.onnx --dataset DATA`. The sub-step forms (cell, particle) are compiled
loops with learned constants, no networks, and are refused with a sentence; so is a liquid's network with
energy=physical, which solves a system of equations at every step.

## LagrangeBench

Data sets in its HDF5 layout (`train.h5`, `valid.h5`, `test.h5`, `metadata.json`) and back, lengths in particle
spacings. `ZSDT_LAGRANGEBENCH_PYTHON=PYTHON pytest tests/interop/test_lagrangebench.py` lets the loader of the package
itself read such files, where PYTHON has it.

{_table(benches)}

`python -m pipelines.export lagrangebench SOURCE OUT`, in the direction that SOURCE asks for.
"""
