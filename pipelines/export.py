"""`python -m pipelines.export vtk|lagrangebench|onnx|results SOURCE OUT`: files for other programs, of what runs left.

vtk: a trajectory file, a data set folder, an evaluation or a twin (folders below outputs/artifacts) -> VTKHDF files for
ParaView in the folder OUT; with `--engine FOLDER` what that engine (or ONNX file) predicts of the trajectories.
lagrangebench: a data set folder -> a LagrangeBench folder OUT; a LagrangeBench folder -> a data set folder OUT.
onnx: a folder of trained weights -> the file OUT, checked against torch; with `--dataset FOLDER` by a rollout as well.
results: the folder of all runs -> a page in OUT with what each export gave when it was opened again.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.provenance import commit_words, provenance, set_thread_environment
from pipelines.store import MANIFEST
from zsdt.errors import DataError, OptionError, ZsdtError

if TYPE_CHECKING:
    from zsdt.trajectory import Trajectory

HELD_OUT = ("test", "beyond", "val")


def main(arguments: Sequence[str] | None = None) -> int:
    """Writes and prints what; returns the exit code."""
    chosen = _words().parse_args(arguments)
    set_thread_environment(1)
    try:
        if not chosen.source.exists():
            raise DataError(f"There is no {chosen.source}; name a file or folder that a run has left.")
        {"vtk": _vtk, "lagrangebench": _lagrangebench, "onnx": _onnx, "results": _results}[chosen.format](chosen)
    except ZsdtError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def _words() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m pipelines.export", description=__doc__)
    formats = parser.add_subparsers(dest="format", required=True)
    for name, what in (
        ("vtk", "VTKHDF files for ParaView"),
        ("lagrangebench", "a data set to or from LagrangeBench"),
        ("onnx", "a trained network as an ONNX file"),
        ("results", "a page about all of them"),
    ):
        each = formats.add_parser(name, help=what)
        each.add_argument("source", type=Path, metavar="SOURCE")
        each.add_argument("out", type=Path, metavar="OUT")
        if name == "results":
            continue
        if name == "lagrangebench":
            each.add_argument("--regime", help="only trajectories of this regime")
            each.add_argument("--unit", choices=("metre", "spacing"), default="metre", help="of length")
            each.add_argument("--no-walls", action="store_true", help="leave out particles on the wall of a vessel")
            continue
        each.add_argument(
            "--split", nargs="+", help="splits of a data set (default: all; for onnx and evaluations what was held out)"
        )
        each.add_argument("--name", nargs="+", help="trajectories of these names")
        each.add_argument("--frames", type=int, help="at most this many frames of a rollout")
        if name == "vtk":
            each.add_argument("--engine", type=Path, help="write what this trained engine predicts")
            each.add_argument("--limit", type=int, help="at most this many trajectories")
        else:
            each.add_argument("--dataset", type=Path, help="data set, or trajectory file, of the rollout that checks")
    return parser


def _vtk(chosen: argparse.Namespace) -> None:
    from zsdt.interop.vtk_export import SUFFIX, write_trajectory_vtk
    from zsdt.twin.twin_states import TWIN_STATES

    source, out = chosen.source, chosen.out
    if _stage_of(source) == "evaluate" and chosen.engine is None:
        return _evaluation(chosen)
    if _stage_of(source) == "twin" and not (source / TWIN_STATES).is_file():
        raise DataError(
            f"The twin in {source} kept no states ({TWIN_STATES} is missing); run it again, with `make demo` say."
        )
    for trajectory in _trajectories(source, chosen.split, chosen.name, chosen.limit):
        if chosen.engine is not None:
            _rollout(trajectory, chosen.engine, out, chosen.frames)
        else:
            _say(write_trajectory_vtk(out / f"{trajectory.name}{SUFFIX}", trajectory), trajectory.frames)


def _evaluation(chosen: argparse.Namespace) -> None:
    """Rolls every trained engine of an evaluation out again, on trajectories that it was judged on."""
    inputs = _manifest(chosen.source).get("inputs", {})
    if "dataset" not in inputs:
        raise DataError(f"The manifest of {chosen.source} names no data set; run its experiment again.")
    shelves = chosen.source.resolve().parents[1]

    def folder(key: str) -> Path:
        found = [path for path in shelves.glob(f"*/{key}") if path.is_dir()]
        if not found:
            raise DataError(f"The artifact {key} that {chosen.source} was made of is gone; run its experiment again.")
        return found[0]

    engines = {role: folder(key) for role, key in inputs.items() if role.partition(".")[0] == "train_tignn"}
    splits = chosen.split or HELD_OUT
    for trajectory in _trajectories(folder(inputs["dataset"]), splits, chosen.name, chosen.limit):
        for role, engine in engines.items():
            name = role.partition(".")[2] or "trained"
            _rollout(trajectory, engine, chosen.out / name, chosen.frames)


def _rollout(trajectory: Trajectory, engine: Path, out: Path, frames: int | None) -> None:
    import torch

    from zsdt.interop.vtk_export import SUFFIX, write_rollout_vtk
    from zsdt.tignn.engine import load_engine, roll_out

    torch.set_num_threads(1)
    if engine.is_file():
        from zsdt.interop.onnx_engine import load_onnx_engine

        loaded = load_onnx_engine(engine)
    else:
        loaded = load_engine(engine)
    rollout = roll_out(loaded, trajectory, min(frames or trajectory.frames, trajectory.frames))
    left = "" if rollout.diverged_at is None else f", diverged at frame {rollout.diverged_at}"
    count = rollout.diverged_at or len(rollout.milliseconds) + 1
    _say(write_rollout_vtk(out / f"{trajectory.name}{SUFFIX}", trajectory, rollout), count, f" of {loaded.name}{left}")


def _say(paths: Sequence[Path], frames: int, more: str = "") -> None:
    for path in paths:
        size = path.stat().st_size / 1e6
        what = "standing still" if path.stem.endswith("_vessel") else f"{frames} frames{more}"
        print(f"{path}: {what}, {size:.1f} MB", flush=True)


def _stage_of(folder: Path) -> str:
    """Stage that made an artifact folder; empty where none did."""
    return str(_manifest(folder).get("stage", "")) if (folder / MANIFEST).is_file() else ""


def _manifest(folder: Path) -> dict[str, Any]:
    try:
        return dict(json.loads((folder / MANIFEST).read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise DataError(f"The manifest of {folder} cannot be read ({error}); run its experiment again.") from error


def _trajectories(
    source: Path, splits: Sequence[str] | None, names: Sequence[str] | None, limit: int | None
) -> Iterator[Trajectory]:
    """Trajectories of a file, a twin or a data set. Raises: DataError where none is as asked."""
    from zsdt.trajectory import Dataset, read_trajectory
    from zsdt.twin.twin_states import TWIN_STATES

    single = source if source.is_file() else source / TWIN_STATES
    if single.is_file():
        yield read_trajectory(single)
        return
    data = Dataset(source)
    entries = [e for e in data.entries if (not splits or e.split in splits) and (not names or e.name in names)]
    if not entries:
        raise DataError(f"{source} has no such trajectories; its names and splits are in {source / 'index.csv'}.")
    yield from (data.read(entry) for entry in entries[:limit])


def _lagrangebench(chosen: argparse.Namespace) -> None:
    from zsdt.interop.lagrangebench import METADATA, LagrangeBenchOptions, Unit, export_lagrangebench
    from zsdt.interop.lagrangebench_import import import_lagrangebench

    if chosen.out.exists():
        raise OptionError(f"{chosen.out} is there already; name a new folder, or remove the old one.")
    if (chosen.source / METADATA).is_file():
        entries = import_lagrangebench(chosen.source, chosen.out)
        print(f"{chosen.out}: a data set of {len(entries)} trajectories, from LagrangeBench")
        return
    options = LagrangeBenchOptions(walls=not chosen.no_walls, regime=chosen.regime, unit=Unit(chosen.unit))
    metadata = export_lagrangebench(chosen.source, chosen.out, options)
    counts = [metadata["num_trajs_train"], metadata["zsdt"]["num_trajs_valid"], metadata["num_trajs_test"]]
    print(f"{chosen.out}: LagrangeBench, {counts[0]} train, {counts[1]} valid, {counts[2]} test trajectories")


def _onnx(chosen: argparse.Namespace) -> None:
    import torch

    from zsdt.interop.onnx_export import export_onnx

    torch.set_num_threads(1)
    trajectory = None
    if chosen.dataset is not None:
        splits = chosen.split or (None if chosen.name else HELD_OUT)
        trajectory = next(_trajectories(chosen.dataset, splits, chosen.name, 1))
    report = export_onnx(chosen.source, chosen.out, trajectory, chosen.frames)
    print(f"{chosen.out}: {report.kind}, {report.size / 1e6:.2f} MB")
    print(_differences("one call on made-up inputs", report.call))
    if report.rollout:
        print(_differences(f"{report.frames} frames of {report.trajectory}", report.rollout))


def _results(chosen: argparse.Namespace) -> None:
    import torch

    from zsdt.evaluation.export_report import export_report

    torch.set_num_threads(1)
    facts = provenance()
    origin = (
        f"Made by `python -m pipelines.export results {chosen.source.name} {chosen.out}` at commit "
        f"{commit_words(facts['git_commit'])} on {facts['machine']}, one thread."
    )
    with tempfile.TemporaryDirectory() as scratch:
        page = export_report(chosen.source, chosen.out, scratch, origin, lambda line: print(line, flush=True))
    print(f"Written: {page}")


def _differences(what: str, found: dict[str, float]) -> str:
    listed = ", ".join(f"{name} {value:.1e}" for name, value in found.items())
    return f"largest difference to torch over the largest value, {what}: {listed}"


if __name__ == "__main__":
    sys.exit(main())
