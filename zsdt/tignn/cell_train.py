"""Training of the sub-step form, from the few constants to the read-out, each stage judged by val rollouts.

1 statics: the constants that the sag of the first frames shows; 2 motion: all of them on whole rollouts, memory
included; 3 boundary: factors of cells at the clamp and the surface; 4 correction: the small network of the energy;
5 readout: stress. Stages 1-4 are Levenberg-Marquardt on the error that is reported, stage 5 is a ridge regression.
"""

from __future__ import annotations

import csv
import hashlib
import json
import logging
import pickle
import shutil
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from zsdt.errors import DataError, RunRejected
from zsdt.files import atomic_path
from zsdt.tignn.cell_energy import CellConstants, CellOptions, EnergyCorrection, card_of, start_constants
from zsdt.tignn.cell_engine import CellEngine, load_cell_engine, plain_options, save_cell_engine
from zsdt.tignn.cell_fit import Case, fit_constants, fit_correction, make_case
from zsdt.tignn.engine import roll_out
from zsdt.tignn.message_passing import receptive_field
from zsdt.tignn.options import TignnOptions, TrainingOptions
from zsdt.tignn.stress_readout import ReadoutFit, StressReadout, equations
from zsdt.trajectory import Dataset, Trajectory

log = logging.getLogger(__name__)

READOUT_BEAMS, READOUT_RIDGE, READOUT_ABSOLUTE = 60, 5e-3, 0.2
STAGES = ("start", "statics", "motion", "boundary", "correction", "readout")


@dataclass
class Learner:
    """What training carries from stage to stage; pickled into `scratch` after each, so that a killed run goes on."""

    constants: CellConstants
    correction: EnergyCorrection | None = None
    readout: StressReadout | None = None
    done: list[str] = field(default_factory=list)
    rows: list[dict[str, Any]] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    seconds: float = 0.0


def train_cell(
    dataset_folder: str | Path,
    options: TignnOptions,
    training: TrainingOptions,
    out: str | Path,
    scratch: str | Path,
    warm_start: str | Path | None = None,
) -> dict[str, Any]:
    """Learns a cell engine from the train beams of a data set and writes its artifact into `out`.

    Writes `engine.json`, `weights.pt`, `training.csv` (errors on the val beams after every stage) and the engine after
    each stage in `stages/`. Gives figures: CPU minutes, the learned constants, val errors,
    names of the beams that were left out.

    Raises: DataError where the data set has no train beams with cells; RunRejected where the model collapses.
    """
    cell = options.cell
    data = Dataset(dataset_folder)
    entries = data.split("train")
    if not entries:
        raise DataError(f"{dataset_folder} has no train trajectories; make the data set with a train split.")
    torch.set_num_threads(1)
    mark = Path(scratch) / f"cell_{_fingerprint(data, cell, training.seed, warm_start)}.pickle"
    learner = _resume(mark)
    chosen = _choose([data.read(e) for e in entries], cell.fit_beams)
    if learner is None:
        learner = _begin(cell, chosen, warm_start)
    for stage in STAGES:
        if stage in learner.done or not _wanted(stage, cell):
            continue
        began = time.process_time()
        _run_stage(stage, learner, cell, training.seed, chosen, data)
        learner.seconds += time.process_time() - began
        _judge(stage, learner, cell, data)
        save_cell_engine(Path(scratch) / "stages" / stage, _engine(learner, cell))
        learner.done.append(stage)
        with atomic_path(mark) as beside:
            beside.write_bytes(pickle.dumps(learner))
    engine = _engine(learner, cell)
    save_cell_engine(out, engine)
    shutil.copytree(Path(scratch) / "stages", Path(out) / "stages", dirs_exist_ok=True)
    _write_rows(Path(out) / "training.csv", learner.rows)
    return {
        "cpu_minutes": round(learner.seconds / 60.0, 3),
        "constants": learner.constants.named(),
        "left_out": learner.left_out,
        "receptive_field": _bounds(engine, chosen),
        "stages": learner.rows,
    }


def _bounds(engine: CellEngine, trajectories: list[Trajectory]) -> list[str]:
    """Sub-steps of a frame, each one local pass, beside what waves and statics ask for; one line per frame time."""
    lines = {}
    for trajectory in trajectories:
        body = trajectory.body
        engine.prepare(body)
        speed = None
        if body.material is not None:
            speed = float(np.sqrt((body.material.bulk + 4 / 3 * body.material.shear) / body.material.density))
        length = float(np.ptp(body.points[:, 0]))
        lines[body.frame_dt] = receptive_field(engine.steps, body.pitch, body.frame_dt, length, speed)
    for line in lines.values():
        log.info("receptive field, one pass a sub-step: %s", line)
    return list(lines.values())


def _fingerprint(data: Dataset, options: CellOptions, seed: int, warm_start: str | Path | None) -> str:
    text = json.dumps([str(data.folder), len(data.entries), plain_options(options), seed, str(warm_start)])
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _resume(mark: Path) -> Learner | None:
    if not mark.is_file():
        return None
    log.info("going on from %s", mark)
    learner: Learner = pickle.loads(mark.read_bytes())
    return learner


def _begin(options: CellOptions, chosen: list[Trajectory], warm_start: str | Path | None) -> Learner:
    """Constants of the options, or those of another run."""
    if warm_start is not None:
        engine = load_cell_engine(Path(warm_start))
        return Learner(engine.constants, engine.correction, engine.readout)
    constants = start_constants(options)
    constants.card = card_of(chosen[0].body)
    return Learner(constants)


def _wanted(stage: str, options: CellOptions) -> bool:
    return {"boundary": options.boundary, "correction": options.correction, "readout": options.readout}.get(stage, True)


def _choose(trajectories: list[Trajectory], per_regime: int) -> list[Trajectory]:
    """Up to `per_regime` trajectories of each frame time, spread over the smaller half of the sizes (cheap to roll)."""
    groups: dict[float, list[Trajectory]] = {}
    for trajectory in trajectories:
        groups.setdefault(round(trajectory.body.frame_dt, 6), []).append(trajectory)
    chosen = []
    for group in groups.values():
        group.sort(key=lambda t: (len(t.body.cells), t.name))
        pool = group[: max(per_regime, (2 * len(group)) // 3)]
        picks = np.unique(np.linspace(0, len(pool) - 1, min(per_regime, len(pool))).round().astype(int))
        chosen += [pool[k] for k in picks]
    return chosen


def _run_stage(
    stage: str, learner: Learner, options: CellOptions, seed: int, chosen: list[Trajectory], data: Dataset
) -> None:
    def tell(iteration: int, error: float, constants: CellConstants | None = None) -> None:
        values = "" if constants is None else ", ".join(f"{k} {v:.4g}" for k, v in constants.named().items())
        log.info("%s %d: rms error of the fitted beams %.4f  %s", stage, iteration, error, values)

    if stage == "readout":
        every_beam = (data.read(e) for e in data.split("train")[:READOUT_BEAMS])
        learner.readout = fit_readout(_engine(learner, options), every_beam, learner.left_out)
        return
    if stage == "start":
        return
    if stage == "correction":
        generator = torch.Generator().manual_seed(seed)
        learner.correction = EnergyCorrection(options.hidden, options.correction_range, generator)
    cases = [make_case(t, learner.constants, options, learner.correction) for t in chosen]
    iterations = options.fit_iterations
    if stage == "statics":
        learner.constants = fit_constants(cases, learner.constants, min(4, iterations), False, False, tell)
        return
    if stage == "motion":
        cases = _without_strays(cases, 3.0, learner.left_out)
        learner.constants = fit_constants(cases, learner.constants, min(3, iterations), True, False, tell)
        for case in cases:
            case.use(learner.constants)
        cases = _without_strays(cases, 0.12, learner.left_out)
        learner.constants = fit_constants(cases, learner.constants, iterations, True, False, tell)
        return
    cases = [c for c in cases if c.trajectory.name not in learner.left_out]
    if stage == "boundary":
        learner.constants = fit_constants(cases, learner.constants, iterations, True, True, tell)
    else:
        assert learner.correction is not None
        fit_correction(cases, learner.correction, max(1, iterations // 2), tell)


def _without_strays(cases: list[Case], limit: float, left_out: list[str]) -> list[Case]:
    """Cases whose error is below `limit` and not five times the median: a tip pushed beyond its buckling load (with
    the dead nodal forces of a trajectory) is an unstable problem that teaches nothing."""
    errors = []
    for case in cases:
        try:
            errors.append(float(np.linalg.norm(case.residual(True))))
        except RunRejected:
            errors.append(np.inf)
    bound = max(limit, 5 * float(np.median(errors)))
    kept = [c for c, e in zip(cases, errors, strict=True) if e < bound]
    for case, error in zip(cases, errors, strict=True):
        if not error < bound:
            log.warning("%s is left out of the fit: error %.2f (near buckling?)", case.trajectory.name, error)
            left_out.append(case.trajectory.name)
    if not kept:
        raise RunRejected("fit", "The cell model diverges on every beam; start from stiffer constants.")
    return kept


def fit_readout(
    engine: CellEngine,
    trajectories: Iterable[Trajectory],
    left_out: list[str],
    every: int = 12,
    ridge: float = READOUT_RIDGE,
    absolute: float = READOUT_ABSOLUTE,
) -> StressReadout:
    """Read-out of stress from rollouts of `engine`, every n-th frame of each.

    It is fitted to the change of stress since the first frame (which is what counts when the first stress is given
    and carried along), and with the weight `absolute` to the stress itself.
    """
    fit = ReadoutFit()
    for trajectory in trajectories:
        if trajectory.name in left_out:
            continue
        body, stress = trajectory.body, trajectory.fields["stress"]
        free = ~body.clamped
        engine.prepare(body)
        state = engine.start(trajectory.at(0), trajectory.load[0])
        weight = 1.0 / max(float((stress[::every, free] ** 2).sum()), 1e-12)
        first = None
        for frame in range(trajectory.frames):
            if frame:
                state = engine.step(state, trajectory.load[frame - 1], trajectory.load[frame])
            if frame % every == 0:
                features, gradients = engine.stress_features(state)
                kinds = engine.kinds[: len(features)]
                found = equations(features, gradients, kinds, body.cells, stress[frame], free)
                first = first or found
                fit.add(found, absolute * weight)
                fit.add(found.less(first), weight)
    return fit.solve(ridge)


def _engine(learner: Learner, options: CellOptions) -> CellEngine:
    return CellEngine(learner.constants, options, learner.correction, learner.readout)


def rollout_errors(engine: CellEngine, trajectory: Trajectory) -> dict[str, float]:
    """RRMSE (fractions) of displacement, velocity and stress over a rollout, and median milliseconds per frame."""
    rollout = roll_out(engine, trajectory)
    free = ~trajectory.body.clamped
    first = trajectory.fields["position"][0]
    errors = {}
    for name in ("displacement", "velocity", "stress"):
        ours, true = (
            f["position"] - first if name == "displacement" else f[name] for f in (rollout.fields, trajectory.fields)
        )
        size = float((true[1:, free] ** 2).sum())
        gap = float(((ours - true)[1:, free] ** 2).sum())
        errors[name] = float(np.sqrt(gap / size)) if np.isfinite(gap) and size > 0 else float("inf")
    return {**errors, "ms_per_frame": float(np.nanmedian(rollout.milliseconds))}


def _judge(stage: str, learner: Learner, options: CellOptions, data: Dataset) -> None:
    """Adds a row per regime of the val beams (train beams where there are none) to the log."""
    entries = data.split("val") or data.split("train")[:4]
    for regime in sorted({e.regime for e in entries}):
        rows = []
        for entry in entries:
            if entry.regime == regime:
                try:
                    rows.append(rollout_errors(_engine(learner, options), data.read(entry)))
                except RunRejected:
                    rows.append({"displacement": np.inf, "velocity": np.inf, "stress": np.inf, "ms_per_frame": np.nan})
        mean = {k: float(np.mean([r[k] for r in rows])) for k in rows[0]}
        worst = float(max(r["displacement"] for r in rows))
        row = {"stage": stage, "regime": regime, "seconds": round(learner.seconds, 1), **mean}
        learner.rows.append({**row, "worst_displacement": worst, "beams": len(rows)})
        log.info(
            "%s, val %s: displacement %.2f %% (worst %.2f %%), velocity %.2f %%, stress %.2f %%, %.2f ms per frame",
            stage, regime, 100 * mean["displacement"], 100 * worst, 100 * mean["velocity"], 100 * mean["stress"],
            mean["ms_per_frame"],
        )  # fmt: skip


def _write_rows(path: Path, rows: list[dict[str, Any]]) -> None:
    with atomic_path(path) as beside, beside.open("w", newline="") as lines:
        writer = csv.DictWriter(lines, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
