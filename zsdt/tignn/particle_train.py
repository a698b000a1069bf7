"""Training of the sub-step form for liquids: first on short windows, then on whole rollouts, each iteration judged
by rollouts on trajectories that it does not learn from; the best is kept."""

from __future__ import annotations

import hashlib
import json
import logging
import pickle
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from zsdt.errors import DataError, RunRejected
from zsdt.files import atomic_path
from zsdt.tignn.choice import write_table
from zsdt.tignn.engine import roll_out
from zsdt.tignn.options import TignnOptions, TrainingOptions
from zsdt.tignn.particle_engine import ParticleEngine, load_particle_engine, save_particle_engine
from zsdt.tignn.particle_fit import Case, Fit, improve
from zsdt.tignn.particle_options import ParticleOptions
from zsdt.tignn.particle_profiles import ParticleProfiles, start_profiles
from zsdt.trajectory import Dataset, DatasetEntry, Trajectory

log = logging.getLogger(__name__)

STAGES = ("windows", "rollouts")
FLOWN_APART = 10.0  # error that a rollout counts which did not survive


@dataclass
class Learner:
    """What training carries on; pickled into `scratch` after each iteration, so that a killed run goes on."""

    fit: Fit
    anchor: ParticleProfiles
    best: ParticleProfiles
    best_score: float = np.inf
    done: dict[str, int] = field(default_factory=dict)
    rows: list[dict[str, Any]] = field(default_factory=list)
    seconds: float = 0.0


def train_particle(
    dataset_folder: str | Path,
    options: TignnOptions,
    training: TrainingOptions,
    out: str | Path,
    scratch: str | Path,
    warm_start: str | Path | None = None,
) -> dict[str, Any]:
    """Learns a particle engine from the train trajectories of a data set and writes its artifact into `out`.

    Writes `engine.json` and `training.csv` (errors on what was held out, after every iteration). `warm_start`: begin
    with the profiles of another run, and be pulled towards them. Gives figures: CPU minutes, iterations, the errors
    of the chosen profiles, names of what was learned from and held out.

    Raises: DataError where there is nothing to learn from; OptionError where the trajectories are no liquids;
    RunRejected where the textbook profiles already fly apart.
    """
    o, data = options.particle, Dataset(dataset_folder)
    torch.set_num_threads(1)
    train, held = _split(data, training, o.fit_trajectories)
    mark = Path(scratch) / f"particle_{_fingerprint(data, o, training, warm_start)}.pickle"
    mark.parent.mkdir(parents=True, exist_ok=True)
    learner = _resume(mark) or _begin(o, warm_start)
    engines = {t.name: _prepared(t, o) for t in (*train, *held)}
    if not learner.rows:
        _judge("start", learner, engines, held)
    for stage in STAGES:
        wanted = o.fit_iterations * (o.fit_windows > 0) if stage == "windows" else o.fit_rollouts
        if wanted == 0:
            continue
        cases = _cases(stage, train, engines, o)
        if stage not in learner.done:
            learner.fit, learner.done[stage] = Fit(learner.best), 0
        while learner.done[stage] < wanted and not learner.fit.stuck:
            began = time.process_time()
            learner.fit = improve(learner.fit, cases, learner.anchor, o.fit_ridge, lambda s: log.info("%s", s))
            learner.seconds += time.process_time() - began
            learner.done[stage] += 1
            _judge(stage, learner, engines, held)
            with atomic_path(mark) as beside:
                beside.write_bytes(pickle.dumps(learner))
            write_table(Path(scratch) / "training.csv", learner.rows)
    save_particle_engine(out, ParticleEngine(learner.best, o))
    write_table(Path(out) / "training.csv", learner.rows)
    return {
        "cpu_minutes": round(learner.seconds / 60.0, 3),
        "iterations": sum(learner.done.values()),
        "parameters": int(learner.best.coefficients.size),
        "best": min(learner.rows, key=lambda row: row["score"]),
        "learned_from": [t.name for t in train],
        "held_out": [t.name for t in held],
        "substeps": {t.name: engines[t.name].steps for t in (*train, *held)},
    }


def _split(data: Dataset, training: TrainingOptions, count: int) -> tuple[list[Trajectory], list[Trajectory]]:
    """Trajectories to learn from, spread over the families, and those that judge: `holdout` by name, else the val
    split, else the last ones of the train split."""
    entries = data.split("train")
    if training.holdout:
        held = [e for e in entries if e.name in training.holdout]
        missing = set(training.holdout) - {e.name for e in held}
        if missing:
            raise DataError(f"holdout names {', '.join(sorted(missing))}, which are no training trajectories.")
    else:
        held = data.split("val")[: max(training.holdout_count, 1)]
        held = held or entries[len(entries) - training.holdout_count :]
    rest = [e for e in entries if e not in held]
    if not rest or not held:
        raise DataError(f"{data.folder} leaves no train trajectories to learn from or none to judge by.")
    return [data.read(e) for e in _spread(rest, count)], [data.read(e) for e in held]


def _spread(entries: list[DatasetEntry], count: int) -> list[DatasetEntry]:
    """`count` of the entries, one family after the other."""
    families = {e.family: [f for f in entries if f.family == e.family] for e in entries}
    order = [members[k] for k in range(len(entries)) for members in families.values() if k < len(members)]
    return order[:count]


def _prepared(trajectory: Trajectory, options: ParticleOptions) -> ParticleEngine:
    engine = ParticleEngine(None, options)
    engine.prepare(trajectory.body)
    return engine


def _cases(
    stage: str, train: list[Trajectory], engines: dict[str, ParticleEngine], options: ParticleOptions
) -> list[Case]:
    """Windows that begin at the first frame and later, or whole rollouts."""
    cases = []
    for t in train:
        last = t.frames - 1
        if stage == "rollouts":
            cases.append(Case(t, engines[t.name], 0, last, options.fit_every, options.fit_energy))
            continue
        length = min(options.fit_frames, last)
        every = max(1, min(options.fit_every, length // 3))
        for k in range(options.fit_windows):
            first = min(k * length, last - length)
            cases.append(Case(t, engines[t.name], first, length, every, options.fit_energy))
    return cases


def _fingerprint(
    data: Dataset, options: ParticleOptions, training: TrainingOptions, warm_start: str | Path | None
) -> str:
    names = [e.name for e in data.entries]
    text = json.dumps(
        [str(data.folder), names, vars(options), training.holdout, training.holdout_count, str(warm_start)]
    )
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _resume(mark: Path) -> Learner | None:
    if not mark.is_file():
        return None
    log.info("going on from %s", mark)
    learner: Learner = pickle.loads(mark.read_bytes())
    return learner


def _begin(options: ParticleOptions, warm_start: str | Path | None) -> Learner:
    """Textbook profiles, or those of another run. Raises: DataError where these have another cutoff or degree."""
    profiles = start_profiles(options.cutoff, options.degree)
    if warm_start is not None:
        other = load_particle_engine(Path(warm_start)).profiles
        if other.cutoff != profiles.cutoff or other.coefficients.shape != profiles.coefficients.shape:
            raise DataError(f"The profiles in {warm_start} have another cutoff or degree; warm-start from the same.")
        profiles = other
    return Learner(Fit(profiles), profiles, profiles)


def rollout_errors(engine: ParticleEngine, trajectory: Trajectory) -> dict[str, float]:
    """RRMSE (fractions) of displacement, velocity and growth of internal energy over a rollout, and median
    milliseconds per frame."""
    rollout = roll_out(engine, trajectory)
    errors = {}
    for name, key in (("displacement", "position"), ("velocity", "velocity"), ("energy", "internal_energy")):
        ours, true = rollout.fields[key], trajectory.fields[key]
        if name != "velocity":
            ours, true = ours - ours[0], true - true[0]
        error = np.sqrt(((ours - true)[1:] ** 2).sum() / max(float((true[1:] ** 2).sum()), 1e-300))
        errors[name] = float(min(error, FLOWN_APART)) if np.isfinite(error) else FLOWN_APART
    return {**errors, "ms_per_frame": float(np.nanmedian(rollout.milliseconds))}


def _judge(stage: str, learner: Learner, engines: dict[str, ParticleEngine], held: list[Trajectory]) -> None:
    """Rolls the present profiles out on what is held out, adds a row, and keeps the best."""
    rows = []
    for trajectory in held:
        engine = engines[trajectory.name]
        engine.use(learner.fit.profiles)
        try:
            rows.append(rollout_errors(engine, trajectory))
        except RunRejected:
            rows.append(dict.fromkeys(("displacement", "velocity", "energy"), FLOWN_APART) | {"ms_per_frame": np.nan})
    mean = {k: float(np.mean([r[k] for r in rows])) for k in rows[0]}
    score = (mean["displacement"] + mean["velocity"] + mean["energy"]) / 3.0
    learner.rows.append(
        {
            "stage": stage,
            "iteration": learner.done.get(stage, 0),
            "cpu_seconds": round(learner.seconds, 1),
            **mean,
            "score": score,
            "cost": learner.fit.cost,
        }
    )
    log.info(
        "%s %d: held out displacement %.2f %%, velocity %.2f %%, energy %.2f %%, %.2f ms per frame",
        stage, learner.done.get(stage, 0), *(100 * mean[k] for k in ("displacement", "velocity", "energy")),
        mean["ms_per_frame"],
    )  # fmt: skip
    if score < learner.best_score:
        learner.best, learner.best_score = learner.fit.profiles, score
