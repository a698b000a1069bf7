"""What is normal: the range of the training data, and what the trust monitor measures where nothing is wrong.

Limits of trust come from here and from nowhere else: training data, rollouts of the trained engine, and closed loops on
clean clips of the virtual lab. Rollouts on bodies of the training and every second pair of clips make the limits;
rollouts on unseen bodies of the same kind and the other clips count false alarms. No hard case is ever looked at
(`trust_report` does that, after the limits are fixed).
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from zsdt.errors import DataError
from zsdt.evaluation.beam_twin_cases import Case, TwinEvaluationOptions
from zsdt.evaluation.beam_twin_cases import run_case as run_beam_case
from zsdt.evaluation.glass_twin_cases import GlassCase, GlassTwinEvaluationOptions, run_glass_case
from zsdt.files import atomic_path
from zsdt.lab.clips import read_clip
from zsdt.lab.glass_clips import read_glass_clip
from zsdt.shipped import TwinWeights
from zsdt.tignn.engine import load_engine, roll_out
from zsdt.trajectory import Trajectory, read_trajectory
from zsdt.twin.trust import SECOND, TrustMonitor, TrustSeries, audit_rollout
from zsdt.twin.trust_gauges import gauge_of
from zsdt.twin.trust_limits import KINDS, Flag, Range, TrustLimits, digest, hull

OPEN, CLOSED = "open loop", "closed loop"
ROLLED = 12  # bodies of the training whose rollouts make limits


@dataclass
class NormalRun:
    """One run in which nothing is wrong: its name, loop (OPEN or CLOSED), and what the monitor measured without any
    limits; card: what does not change. calibrates: whether it makes limits or tests them. milliseconds [frames]: that
    judging a frame took, none in an open loop."""

    name: str
    loop: str
    series: TrustSeries
    card: dict[str, float]
    calibrates: bool
    milliseconds: Float[np.ndarray, " frames"] = field(default_factory=lambda: np.zeros(0))

    def ranges(self) -> dict[str, Range]:
        """Least and greatest of every value over the frames."""
        return {**_points(self.card), **ranges_of(self.series)}

    def alarms(self, limits: TrustLimits) -> list[str]:
        """The flags that each frame has under `limits`."""
        flagged: list[set[Flag]] = [set() for _ in self.series.flags]
        known = limits.within(self.loop == OPEN)
        steady = {name: np.full(len(flagged), value) for name, value in self.card.items()}
        for name, values in {**self.series.values, **steady}.items():
            low, high = known.get(name, (-np.inf, np.inf))
            with np.errstate(invalid="ignore"):
                outside = (values < low) | (values > high)
            for k in np.flatnonzero(outside):
                flagged[k].add(KINDS[name].flag)
        return [" ".join(f for f in Flag if f in flags) for flags in flagged]


def ranges_of(series: TrustSeries) -> dict[str, Range]:
    """Least and greatest finite number of every value."""
    found = {}
    for name, values in series.values.items():
        known = values[np.isfinite(values)]
        if len(known):
            found[name] = (float(known.min()), float(known.max()))
    return found


def _points(card: dict[str, float]) -> dict[str, Range]:
    return {name: (value, value) for name, value in card.items() if np.isfinite(value)}


def files_of(data: Path, splits: Sequence[str]) -> list[Path]:
    """Trajectories of a data set (a folder of the stage `synthesize`) in the given splits.

    Raises: DataError where the folder is none, or has none of them.
    """
    index = data / "index.csv"
    if not index.is_file():
        raise DataError(f"{data} holds no data set (index.csv is missing); name a folder of the stage synthesize.")
    with index.open() as file:
        found = [data / row["file"] for row in csv.DictReader(file) if row["split"] in splits]
    if not found:
        raise DataError(f"{data} has no trajectories in {' or '.join(splits)}; name another data set.")
    return found


def training_ranges(data: Path) -> dict[str, Range]:
    """Range of every gauge over all frames of the training split."""
    return hull(trajectory_ranges(read_trajectory(path)) for path in files_of(data, ["train"]))


def trajectory_ranges(trajectory: Trajectory) -> dict[str, Range]:
    """Range of every gauge over the frames of one trajectory."""
    gauge, fields = gauge_of(trajectory.body), trajectory.fields
    second = next((fields[name] for name in SECOND if name in fields), None)
    rows = [
        gauge.frame(p, v, load, None if second is None else second[k])
        for k, (p, v, load) in enumerate(zip(fields["position"], fields["velocity"], trajectory.load, strict=True))
    ]
    return hull([_points(gauge.card), *(_points(row) for row in rows)])


def open_runs(data: Path, folder: Path, kept: Path, again: bool = False) -> Iterable[NormalRun]:
    """Rollouts of the engine in `folder`: on bodies of its training, and on unseen ones of the same kind to test.

    kept, again: see `closed_runs`.
    """
    trained = files_of(data, ["train"])[:ROLLED]
    for path in [*trained, *files_of(data, ["val", "test"])]:
        beside = kept / f"{data.resolve().name}_{path.stem}_{digest(folder)}.json"
        if again or not beside.is_file():
            engine, truth = load_engine(folder), read_trajectory(path)
            series = audit_rollout(engine, truth, roll_out(engine, truth))
            _keep(beside, NormalRun(truth.name, OPEN, series, TrustMonitor(None, truth.body).card, path in trained))
        yield _kept(beside)


def clip_folders(clips: Path) -> list[Path]:
    """Clips of the virtual lab below `clips`. Raises: DataError where there is none."""
    found = sorted(path for path in clips.glob("clip_*") if path.is_dir())
    if not found:
        raise DataError(f"{clips} holds no clips of the virtual lab; name a folder of the stage film.")
    return found


def closed_runs(
    clips: Path, weights: TwinWeights, most: int, kept: Path, lab_masks: bool = False, again: bool = False
) -> Iterable[NormalRun]:
    """Closed loops on clean clips, beams or glasses. lab_masks: the lab's own masks instead of the segmentation's.

    kept: folder in which every run is kept, so that a calibration that was cut off goes on where it was; again: runs
    what is kept there, too.
    """
    for number, folder in enumerate(clip_folders(clips)[:most]):
        eye = "lab" if lab_masks else "seen"
        path = kept / f"{clips.resolve().name}_{folder.name}_{eye}_{digest(weights.tignn)}.json"
        if again or not path.is_file():
            _keep(path, closed_run(folder, weights, lab_masks, number % 4 < 2))
        yield _kept(path)


def closed_run(folder: Path, weights: TwinWeights, lab_masks: bool, calibrates: bool) -> NormalRun:
    """The closed loop on one clip."""
    log: Any
    if (folder / "pose.npy").is_file():
        case = GlassCase.masks if lab_masks else GlassCase.closed
        log = run_glass_case(read_glass_clip(folder), case, weights, GlassTwinEvaluationOptions())
        found: dict[str, float] = {}
    else:
        log = run_beam_case(read_clip(folder), Case.closed, weights, TwinEvaluationOptions())
        found = {"stiffness_found": log.stiffness, "density_found": log.density}
    card = TrustMonitor(None, log.body, found).card
    return NormalRun(folder.name, CLOSED, log.trust, card, calibrates, log.latency["trust"])


def _keep(path: Path, run: NormalRun) -> None:
    """A run as JSON; its flags are those of the limits of that time, and nobody reads them again."""
    values = {name: _numbers(series) for name, series in run.series.values.items()}
    card = {**vars(run), "series": values, "milliseconds": _numbers(run.milliseconds)}
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as beside:
        beside.write_text(json.dumps(card))


def _numbers(values: Float[np.ndarray, " n"]) -> list[float | None]:
    return [float(x) if np.isfinite(x) else None for x in values]


def _kept(path: Path) -> NormalRun:
    """What `_keep` wrote. Raises: DataError where it is broken."""
    try:
        card = json.loads(path.read_text())
        values = {name: np.array(series, float) for name, series in card.pop("series").items()}
        times = np.array(card.pop("milliseconds"), float)
        nothing = [""] * max(map(len, values.values()))
        return NormalRun(**card, series=TrustSeries(nothing, nothing, values), milliseconds=times)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path} is no run of a calibration ({error}); delete it.") from error


def calibrated(training: dict[str, Range], runs: Sequence[NormalRun], about: dict[str, Any]) -> TrustLimits:
    """Limits around the training's range and that of the runs that calibrate.

    Raises: DataError where no run calibrates.
    """
    chosen = [run for run in runs if run.calibrates]
    if not chosen:
        raise DataError("No run is there to calibrate with; name more data or clips.")
    alone, twin = (hull(run.ranges() for run in chosen if run.loop == loop) for loop in (OPEN, CLOSED))
    names = [{"run": run.name, "loop": run.loop, "frames": len(run.series.flags)} for run in chosen]
    return TrustLimits.of(training, alone, twin, {**about, "normal_runs": names})
