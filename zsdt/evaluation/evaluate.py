"""Rolls out every method on every evaluated trajectory and writes the tables that the report is made of.

`evaluate` writes below its output folder:

- `metrics.csv`: one row per method and trajectory. `<field>_rmse` in SI and `<field>_rrmse` as fractions for position,
  displacement, velocity, stress, von_mises, axial_stress, internal_energy, energy_increment (whatever both sides have);
  frequency_hz, true_frequency_hz, frequency_error; error_growth; diverged_at; long_diverged_at; ms_p50, ms_p95;
  ledger_residual, entropy_min and distances from the solver's account (`zsdt.evaluation.ledger`); probe_* for the
  first trajectory of each regime (`zsdt.evaluation.degeneracy`); of liquids all of `zsdt.evaluation.liquid_metrics`
  and the milliseconds of graph and network.
- `errors_over_time.csv`: method, trajectory, split, regime, frame, time_s, then one relative error per field; of
  liquids centroid and levels too.
- `summary.csv`, `summary.md`, `summary.json`: per method, split and regime, mean and worst over the trajectories.
- `recordings/<method>/<trajectory>.rrd`: for the Rerun viewer; of liquids `pictures/<trajectory>_*.png` beside.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from zsdt.errors import DataError, OptionError
from zsdt.evaluation import tables
from zsdt.evaluation.degeneracy import degeneracy
from zsdt.evaluation.judges import Judge, Series, judge_of, milliseconds
from zsdt.evaluation.stability import left_range, long_figures
from zsdt.files import atomic_path
from zsdt.tignn.engine import Engine, Rollout, roll_out
from zsdt.trajectory import Dataset, DatasetEntry, Trajectory

Progress = Callable[[int, int, str], None]


@dataclass
class EvaluationOptions:
    """What is evaluated and what is kept.

    splits, regimes: which trajectories (no regime named: all). per_group: at most so many of each split and regime
    (0: all). frames: frames of a rollout, the first included (0: all). recordings: rollouts that are recorded per
    method, spread over splits and regimes. skip_recordings: methods that need none. from_psi_ini: the first engine once
    more with the hidden fields of its first frame from Psi_ini, as a twin starts, instead of from the data.
    long_frames: frames of the stability check, in which the last load is held (0: none); long_trajectories: how many
    per regime get it. warm_up: frames before the clock starts. frequency_quality: share of the variance that a damped
    cosine must explain before the frequency of a solid counts.
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

    Returns: {"threads", "trajectories", "rows" (summary), "recordings", "pictures"}, as in `summary.json`.
    Raises: DataError where the data set has none of the wanted trajectories.
    """
    folder = Path(out)
    dataset = Dataset(dataset_folder)
    entries = chosen_entries(dataset, options)
    recorded = _spread(entries, options.recordings)
    long_checked = _first_of_regimes(entries, options.long_trajectories if options.long_frames else 0)
    probed = _first_of_regimes(entries, 1)
    rows: list[dict[str, Any]] = []
    curves: list[dict[str, Any]] = []
    recordings: list[str] = []
    pictures: list[str] = []
    total, done = len(entries) * len(engines), 0
    for entry in entries:
        trajectory = shortened(dataset.read(entry), options.frames)
        judge = judge_of(trajectory, options.frequency_quality)
        kept: dict[str, Rollout] = {}
        for name, engine in engines.items():
            done += 1
            if not _applies(engine, trajectory):
                continue
            roll_out(engine, trajectory, min(trajectory.frames, 1 + options.warm_up))
            rollout = replace(roll_out(engine, trajectory), name=name)
            row = _row(name, entry, trajectory, rollout, judge)
            if entry in long_checked:
                row |= long_figures(engine, trajectory, options.long_frames)
            if entry in probed:
                row |= degeneracy(engine, trajectory)
            rows.append(row)
            curves.extend(_curve_rows(name, entry, trajectory, judge.curves(rollout)))
            if entry in recorded:
                kept[name] = rollout
            if entry in recorded and name not in options.skip_recordings:
                recordings.append(_record(folder, name, entry, trajectory, rollout, config_text))
            if progress is not None:
                progress(done, total, f"{name} on {entry.name}")
        for title, png in judge.pictures(kept).items() if kept else ():
            pictures.append(f"pictures/{entry.name}_{title}.png")
            with atomic_path(folder / pictures[-1]) as beside:
                beside.write_bytes(png)
    summary = {
        "threads": _threads(),
        "trajectories": len(entries),
        "rows": tables.summarise(rows),
        "recordings": recordings,
        "pictures": pictures,
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


def chosen_entries(dataset: Dataset, options: EvaluationOptions) -> list[DatasetEntry]:
    """The trajectories that the options name; of a limited group in turn one of each family.

    Raises: DataError where the data set has none of them.
    """
    wanted = [e for e in dataset.split(*options.splits) if not options.regimes or e.regime in options.regimes]
    if not wanted:
        raise DataError(
            f"{dataset.folder} has no trajectory of the splits {', '.join(options.splits)}"
            f"{' and regimes ' + ', '.join(options.regimes) if options.regimes else ''}; evaluate others."
        )
    if options.per_group == 0:
        return wanted
    groups: dict[tuple[str, str], dict[str, list[DatasetEntry]]] = {}
    for entry in wanted:
        groups.setdefault((entry.split, entry.regime), {}).setdefault(entry.family, []).append(entry)
    kept = [e for families in groups.values() for e in _in_turn(list(families.values()))[: options.per_group]]
    return [entry for entry in wanted if entry in kept]


def _spread(entries: list[DatasetEntry], count: int) -> list[DatasetEntry]:
    """`count` entries, taken in turn from each split and regime."""
    groups: dict[tuple[str, str], list[DatasetEntry]] = {}
    for entry in entries:
        groups.setdefault((entry.split, entry.regime), []).append(entry)
    return _in_turn(list(groups.values()))[:count]


def _in_turn(groups: list[list[DatasetEntry]]) -> list[DatasetEntry]:
    """The first of each group, then the second of each, and so on."""
    return [g[k] for k in range(max(map(len, groups))) for g in groups if k < len(g)]


def _first_of_regimes(entries: list[DatasetEntry], count: int) -> list[DatasetEntry]:
    regimes: dict[str, list[DatasetEntry]] = {}
    for entry in entries:
        regimes.setdefault(entry.regime, []).append(entry)
    return [e for group in regimes.values() for e in group[:count]]


def _row(name: str, entry: DatasetEntry, trajectory: Trajectory, rollout: Rollout, judge: Judge) -> dict[str, Any]:
    body = trajectory.body
    return {
        **_keys(name, entry),
        "family": entry.family,
        "nodes": body.nodes,
        "frames": len(rollout.fields["position"]),
        "frame_dt_s": body.frame_dt,
        **judge.figures(rollout),
        "diverged_at": left_range(trajectory, rollout),
        "long_frames": None,
        "long_diverged_at": None,
        **milliseconds(rollout),
        "threads": _threads(),
    }


def _keys(name: str, entry: DatasetEntry) -> dict[str, str]:
    return {"method": name, "trajectory": entry.name, "split": entry.split, "regime": entry.regime}


def _curve_rows(name: str, entry: DatasetEntry, trajectory: Trajectory, curves: Series) -> list[dict[str, Any]]:
    keys = _keys(name, entry)
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
