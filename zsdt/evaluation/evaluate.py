"""Rolls out every method on every evaluated trajectory and writes the tables that the report is made of.

`evaluate` writes below its output folder:

- `metrics.csv`: one row per method and trajectory. `<field>_rmse` in SI and `<field>_rrmse` as fractions for position,
  displacement, velocity, stress, von_mises, axial_stress (and energies where both sides have them);
  frequency_hz, true_frequency_hz, frequency_error; error_growth; diverged_at; long_diverged_at; ms_p50, ms_p95;
  ledger_residual, entropy_min and distances from the solver's account (`zsdt.evaluation.ledger`); probe_* for the
  first trajectory of each regime (`zsdt.evaluation.degeneracy`).
- `errors_over_time.csv`: method, trajectory, split, regime, frame, time_s, then one relative error per field.
- `summary.csv`, `summary.md`, `summary.json`: per method, split and regime, mean and worst over the trajectories.
- `recordings/<method>/<trajectory>.rrd`: for the Rerun viewer.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from zsdt.errors import DataError, OptionError
from zsdt.evaluation import tables
from zsdt.evaluation.degeneracy import degeneracy
from zsdt.evaluation.ledger import ledger_figures
from zsdt.evaluation.metrics import error_growth, errors_over_time, field_errors
from zsdt.evaluation.modal import frequencies
from zsdt.tignn.engine import Engine, Rollout, roll_out
from zsdt.trajectory import Dataset, DatasetEntry, Trajectory

Progress = Callable[[int, int, str], None]


@dataclass
class EvaluationOptions:
    """What is evaluated and what is kept.

    splits, regimes: which trajectories (no regime named: all). per_group: at most so many of each split and regime
    (0: all). frames: frames of a rollout, the first included (0: all). recordings: rollouts that are recorded per
    method, spread over splits and regimes. skip_recordings: methods that need none. from_psi_ini: the first engine once
    more with its first stress from Psi_ini, as a twin starts, instead of from the data. long_frames: frames of the
    stability check, in which the last load is held (0: none); long_trajectories: how many per regime get it.
    warm_up: frames before the clock starts. frequency_quality: share of the variance that a damped cosine must explain
    before its frequency counts.
    """

    splits: list[str] = field(default_factory=lambda: ["test", "beyond"])
    regimes: list[str] = field(default_factory=list)
    per_group: int = 0
    frames: int = 0
    recordings: int = 2
    skip_recordings: list[str] = field(default_factory=lambda: ["static", "inertia"])
    from_psi_ini: bool = True
    long_frames: int = 0
    long_trajectories: int = 1
    warm_up: int = 3
    frequency_quality: float = 0.9

    def __post_init__(self) -> None:
        if not self.splits:
            raise OptionError("Evaluation needs at least one split; name some of train, val, test, beyond.")
        if min(self.per_group, self.frames, self.recordings, self.long_frames, self.warm_up) < 0:
            raise OptionError("Counts of an evaluation cannot be negative; use 0 for all or none.")
        if self.frames == 1:
            raise OptionError("A rollout of one frame predicts nothing; set frames to 2 or more, or 0 for all.")


def evaluate(
    dataset_folder: str | os.PathLike[str],
    engines: Mapping[str, Engine],
    options: EvaluationOptions,
    out: str | os.PathLike[str],
    config_text: str = "",
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Evaluates `engines` (name -> engine) on a data set and writes tables and recordings into `out`.

    Methods alternate within each trajectory, in this process, so that none profits from a quieter machine;
    compilation and the first `warm_up` frames are outside the clock. A method with `applies_to(body)` is left out
    where it says no. `config_text` goes into the recordings.
    `progress(done, total, what)` is called after each rollout.

    Returns: {"threads", "trajectories", "rows" (summary), "recordings"}, as in `summary.json`.
    Raises: DataError where the data set has none of the wanted trajectories.
    """
    folder = Path(out)
    dataset = Dataset(dataset_folder)
    entries = _chosen(dataset, options)
    recorded = _spread(entries, options.recordings)
    long_checked = _first_of_regimes(entries, options.long_trajectories if options.long_frames else 0)
    probed = _first_of_regimes(entries, 1)
    rows: list[dict[str, Any]] = []
    curves: list[dict[str, Any]] = []
    recordings: list[str] = []
    total, done = len(entries) * len(engines), 0
    for entry in entries:
        trajectory = shortened(dataset.read(entry), options.frames)
        for name, engine in engines.items():
            done += 1
            if not _applies(engine, trajectory):
                continue
            roll_out(engine, trajectory, min(trajectory.frames, 1 + options.warm_up))
            rollout = replace(roll_out(engine, trajectory), name=name)
            row = _row(name, entry, trajectory, rollout, options)
            if entry in long_checked:
                row["long_diverged_at"] = stability_check(engine, trajectory, options.long_frames)
                row["long_frames"] = options.long_frames
            if entry in probed:
                row |= degeneracy(engine, trajectory)
            rows.append(row)
            curves.extend(_curve_rows(name, entry, trajectory, rollout))
            if entry in recorded and name not in options.skip_recordings:
                recordings.append(_record(folder, name, entry, trajectory, rollout, config_text))
            if progress is not None:
                progress(done, total, f"{name} on {entry.name}")
    summary = {
        "threads": _threads(),
        "trajectories": len(entries),
        "rows": tables.summarise(rows),
        "recordings": recordings,
    }
    tables.write_all(folder, rows, curves, summary)
    return summary


def _applies(engine: Engine, trajectory: Trajectory) -> bool:
    """Whether the method can predict this body; a coarse mesh, say, may not fit its sizes. Most always can."""
    applies_to = getattr(engine, "applies_to", None)
    return applies_to is None or bool(applies_to(trajectory.body))


def shortened(trajectory: Trajectory, frames: int) -> Trajectory:
    """The first `frames` frames of a trajectory; all of them for 0 or more than it has."""
    if not 0 < frames < trajectory.frames:
        return trajectory
    return replace(
        trajectory,
        times=trajectory.times[:frames],
        fields={k: v[:frames] for k, v in trajectory.fields.items()},
        load=trajectory.load[:frames],
        ledger={k: v[:frames] for k, v in trajectory.ledger.items()},
    )


def left_range(trajectory: Trajectory, rollout: Rollout) -> int | None:
    """First frame that is not finite or in which a node is further than a body length from its reference place.

    A rollout can be wrong without end and still be finite, so the second half of the question matters.
    """
    points = trajectory.body.points
    length = float(np.linalg.norm(np.ptp(points, axis=0)))
    position = rollout.fields["position"]
    with np.errstate(invalid="ignore"):
        inside = np.linalg.norm(position - points, axis=2).max(axis=1) <= length
    outside = np.flatnonzero(~inside)
    return int(outside[0]) if len(outside) else None


def stability_check(engine: Engine, trajectory: Trajectory, frames: int) -> int | None:
    """Rolls out for `frames` frames, the last load held; the frame at which it diverged (`left_range`) or None."""
    extra = max(frames - trajectory.frames, 0)
    held = np.repeat(trajectory.load[-1:], extra, axis=0)
    longer = replace(
        trajectory,
        times=trajectory.body.frame_dt * np.arange(frames),
        fields={k: np.broadcast_to(v[0], (frames, *v[0].shape)) for k, v in trajectory.fields.items()},  # only a start
        load=np.concatenate([trajectory.load, held])[:frames],
        ledger={},
    )
    return left_range(longer, roll_out(engine, longer, frames))


def evaluate_initial_stress(
    dataset_folder: str | os.PathLike[str], initial: Any, options: EvaluationOptions
) -> dict[str, Any]:
    """Judges a network of first stresses (Psi_ini) on the first frames of the evaluated trajectories.

    `initial` has `infer(body, positions [nodes, 3] m) -> stress [nodes, 6] Pa`.

    Returns: per split the mean and worst over trajectories of RMSE [Pa] and RRMSE [-] of the axial component and of
    von Mises, over the free nodes (the seed reports these two): {"rows": [...], "trajectories": n}.
    """
    dataset = Dataset(dataset_folder)
    rows = []
    for entry in _chosen(dataset, options):
        trajectory = dataset.read(entry)
        first = trajectory.at(0)
        stress = np.asarray(initial.infer(trajectory.body, first["position"]), np.float64)
        # Two equal frames, because errors are taken over all frames but the first.
        predicted = {"position": np.stack([first["position"]] * 2), "stress": np.stack([stress] * 2)}
        truth = {"position": predicted["position"], "stress": np.stack([first["stress"]] * 2)}
        errors = field_errors(predicted, truth, ~trajectory.body.clamped)
        kept = {k: v for k, v in errors.items() if k.startswith(("axial_stress", "von_mises", "stress"))}
        rows.append({"method": "psi_ini", "trajectory": entry.name, "split": entry.split, "regime": "rest", **kept})
    return {"trajectories": len(rows), "rows": tables.summarise(rows), "per_trajectory": rows}


def _chosen(dataset: Dataset, options: EvaluationOptions) -> list[DatasetEntry]:
    wanted = [e for e in dataset.split(*options.splits) if not options.regimes or e.regime in options.regimes]
    if not wanted:
        raise DataError(
            f"{dataset.folder} has no trajectory of the splits {', '.join(options.splits)}"
            f"{' and regimes ' + ', '.join(options.regimes) if options.regimes else ''}; evaluate others."
        )
    if options.per_group == 0:
        return wanted
    groups: dict[tuple[str, str], int] = {}
    kept = []
    for entry in wanted:
        key = (entry.split, entry.regime)
        groups[key] = groups.get(key, 0) + 1
        if groups[key] <= options.per_group:
            kept.append(entry)
    return kept


def _spread(entries: list[DatasetEntry], count: int) -> list[DatasetEntry]:
    """`count` entries, taken in turn from each split and regime."""
    groups: dict[tuple[str, str], list[DatasetEntry]] = {}
    for entry in entries:
        groups.setdefault((entry.split, entry.regime), []).append(entry)
    turns = [g[k] for k in range(max(map(len, groups.values()))) for g in groups.values() if k < len(g)]
    return turns[:count]


def _first_of_regimes(entries: list[DatasetEntry], count: int) -> list[DatasetEntry]:
    regimes: dict[str, list[DatasetEntry]] = {}
    for entry in entries:
        regimes.setdefault(entry.regime, []).append(entry)
    return [e for group in regimes.values() for e in group[:count]]


def _row(
    name: str, entry: DatasetEntry, trajectory: Trajectory, rollout: Rollout, options: EvaluationOptions
) -> dict[str, Any]:
    body = trajectory.body
    free = ~body.clamped
    ours, theirs = frequencies(
        body, rollout.fields["position"], trajectory.fields["position"], trajectory.load, options.frequency_quality
    )
    clock = rollout.milliseconds[np.isfinite(rollout.milliseconds)]
    curves = errors_over_time(rollout.fields, trajectory.fields, free)
    diverged = left_range(trajectory, rollout)
    return {
        "method": name,
        "trajectory": entry.name,
        "split": entry.split,
        "regime": entry.regime,
        "nodes": body.nodes,
        "frames": len(rollout.fields["position"]),
        "frame_dt_s": body.frame_dt,
        **field_errors(rollout.fields, trajectory.fields, free),
        "error_growth": error_growth(curves["displacement"]),
        "frequency_hz": ours,
        "true_frequency_hz": theirs,
        "frequency_error": abs(ours / theirs - 1.0),
        "diverged_at": diverged,
        "long_frames": None,
        "long_diverged_at": None,
        "ms_p50": float(np.median(clock)) if len(clock) else float("nan"),
        "ms_p95": float(np.percentile(clock, 95)) if len(clock) else float("nan"),
        "threads": _threads(),
        **ledger_figures(rollout, trajectory),
    }


def _curve_rows(name: str, entry: DatasetEntry, trajectory: Trajectory, rollout: Rollout) -> list[dict[str, Any]]:
    curves = errors_over_time(rollout.fields, trajectory.fields, ~trajectory.body.clamped)
    keys = {"method": name, "trajectory": entry.name, "split": entry.split, "regime": entry.regime}
    return [
        {**keys, "frame": k, "time_s": float(trajectory.times[k]), **{f: float(c[k]) for f, c in curves.items()}}
        for k in range(len(curves["position"]))
    ]


def _record(
    folder: Path, name: str, entry: DatasetEntry, trajectory: Trajectory, rollout: Rollout, config_text: str
) -> str:
    from zsdt.twin.recording import record_rollout  # the viewer's library is heavy; only who records pays for it

    folder_name = re.sub(r"[^\w.+-]", "_", name)
    relative = Path("recordings") / folder_name / f"{entry.name}.rrd"
    record_rollout(folder / relative, trajectory, rollout, config_text=config_text)
    return relative.as_posix()


def _threads() -> int:
    """Threads that a method may use: what the numerical libraries were told, else the cores of this process."""
    told = os.environ.get("OMP_NUM_THREADS", "")
    return int(told) if told.isdigit() and int(told) > 0 else len(os.sched_getaffinity(0))
