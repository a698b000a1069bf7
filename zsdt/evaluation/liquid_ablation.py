"""What each choice brings for liquids: in the node form, all trained for the same number of steps, and in sub-steps.

`python -m zsdt.evaluation.liquid_ablation DATASET OUT [--water DATASET] [--steps N] [--only NAME ...]`

DATASET: folder of a data set of liquids; OUT: path without suffix. OUT.csv and OUT.md are written, one row per variant
and split (test: unseen fills and stops; beyond: a family of vessels that was never trained on). `--water` trains the
reference on another data set first and starts a variant from its weights. Engines are kept in the folder OUT: a run
that was cut short goes on, and rows of variants that are not named in `--only` stay.
"""

from __future__ import annotations

import argparse
import csv
import json
import logging
import shlex
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from zsdt.errors import DataError, ZsdtError
from zsdt.evaluation.metrics import field_errors
from zsdt.files import atomic_path
from zsdt.tignn.engine import Engine, load_engine, roll_out
from zsdt.tignn.liquid_engine import LiquidEngine, load_model
from zsdt.tignn.options import Bracket, Energy, Form, LiquidOptions, TignnOptions, TrainingOptions, Walls
from zsdt.tignn.particle_options import ParticleOptions
from zsdt.tignn.train import train_engine
from zsdt.trajectory import Dataset

COLUMNS = (
    "variant", "split", "liquids", "displacement_percent", "worst_displacement", "velocity_percent", "worst_velocity",
    "energy_percent", "position_percent", "kinetic_at_end_ratio", "diverged", "steps", "cpu_s_per_1000_steps",
    "cpu_minutes", "ms_per_frame",
)  # fmt: skip
ERRORS = {"displacement": "displacement", "velocity": "velocity", "energy": "energy_increment", "position": "position"}
COSTS = ("steps", "cpu_minutes")
REFERENCE = "exact, energy learned"
PHYSICAL = "exact, energy physical"
RELAXED = "2 sweeps of relaxation"
FROM_WATER = "warm start from water"
UNTAUGHT = "sub-steps, nothing learned"


@dataclass
class Variant:
    """Options of the network and of its training; `of`: the variant whose weights it takes instead of training."""

    tignn: TignnOptions
    training: TrainingOptions
    of: str | None = None
    warm: bool = False


@dataclass
class Settings:
    """Sizes that all variants share; steps: of the training of each."""

    steps: int = 500
    passes: int = 4
    width: int = 48
    batch: int = 1
    noise: float = 0.02
    unroll: int = 4
    seed: int = 0
    liquid: LiquidOptions = field(default_factory=LiquidOptions)


def variants(settings: Settings) -> dict[str, Variant]:
    """The reference (exact brackets, learned energy, walls as features, push-forward 4, context), and one choice
    changed at a time."""
    tignn = TignnOptions(passes=settings.passes, width=settings.width, liquid=settings.liquid)
    training = TrainingOptions(
        steps=settings.steps,
        batch=settings.batch,
        noise=settings.noise,
        unroll=settings.unroll,
        check_every=max(settings.steps // 2, 1),
        checkpoint_every=max(settings.steps // 2, 1),
        holdout_count=1,
        seed=settings.seed,
    )

    def changed(**choices: Any) -> Variant:
        return Variant(replace(tignn, **choices), training)

    found = {
        REFERENCE: Variant(tignn, training),
        PHYSICAL: changed(energy=Energy.physical),
        "soft (seed)": changed(bracket=Bracket.soft),
        "none (black box)": changed(bracket=Bracket.none),
        "walls as nodes (seed)": changed(liquid=replace(settings.liquid, walls=Walls.nodes)),
        "no global context": changed(global_context=False),
    }
    for unroll in (1, 8):
        found[f"push-forward {unroll}"] = Variant(tignn, replace(training, unroll=unroll))
    found[RELAXED] = Variant(replace(tignn, liquid=replace(settings.liquid, relaxation=2)), training, of=REFERENCE)
    found[FROM_WATER] = Variant(tignn, training, warm=True)
    return found | sub_step_variants(settings)


def sub_step_variants(settings: Settings) -> dict[str, Variant]:
    """The sub-step form as it is, and what its learning and its choices are worth."""
    as_it_is = ParticleOptions()
    untaught = replace(as_it_is, fit_iterations=0, fit_rollouts=0)
    forms = {
        UNTAUGHT: untaught,
        "sub-steps, profiles learned": as_it_is,
        "sub-steps, cutoff 2.5 spacings, nothing learned": replace(untaught, cutoff=2.5),
        "sub-steps, sound at 13 m/s, nothing learned": replace(untaught, sound_speed=13.0),
    }
    training = TrainingOptions(seed=settings.seed)
    return {name: Variant(TignnOptions(form=Form.particle, particle=o), training) for name, o in forms.items()}


def _folder(out: Path, name: str) -> Path:
    return out / "".join(c if c.isalnum() else "_" for c in name)


def _trained(dataset: Path, variant: Variant, folder: Path, warm_start: Path | None) -> dict[str, Any]:
    """Figures of a training; taken from the folder where it is complete."""
    kept = folder / "figures.json"
    if not kept.is_file():
        figures = train_engine(dataset, variant.tignn, variant.training, folder, folder / "scratch", warm_start)
        with atomic_path(kept) as beside:
            beside.write_text(json.dumps(figures))
    return json.loads(kept.read_text())


def _engine(out: Path, name: str, variant: Variant) -> Engine:
    if variant.of is None:
        return load_engine(_folder(out, name))
    model = load_model(_folder(out, variant.of))
    model.options = variant.tignn
    return LiquidEngine(model)


def judge(engine: Engine, data: Dataset, split: str) -> dict[str, Any]:
    """Mean and worst errors [%] over a split, whole rollouts; a diverged one is counted and not in the means."""
    rows, clock, ratios, diverged = [], [], [], 0
    for entry in data.split(split):
        trajectory = data.read(entry)
        rollout = roll_out(engine, trajectory)
        if rollout.diverged_at is not None:
            diverged += 1
            continue
        rows.append(field_errors(rollout.fields, trajectory.fields, ~trajectory.body.clamped))
        last = [np.square(f["velocity"][-1]).sum() for f in (rollout.fields, trajectory.fields)]
        ratios.append(float(last[0] / max(last[1], 1e-300)))
        clock.append(rollout.milliseconds[3:])
    found: dict[str, Any] = {"liquids": len(rows) + diverged, "diverged": diverged}
    if not rows:
        return found
    for name, key in ERRORS.items():
        values = [100.0 * r[f"{key}_rrmse"] for r in rows]
        found[f"{name}_percent"] = round(float(np.mean(values)), 2)
        if f"worst_{name}" in COLUMNS:
            found[f"worst_{name}"] = round(max(values), 2)
    found["kinetic_at_end_ratio"] = round(float(np.median(ratios)), 2)
    found["ms_per_frame"] = round(float(np.median(np.concatenate(clock))), 2)
    return found


def ablate(
    dataset: str | Path,
    out: str | Path,
    water: str | Path | None = None,
    settings: Settings | None = None,
    only: list[str] | None = None,
    command: str = "",
) -> list[dict[str, Any]]:
    """Trains and judges the variants and writes OUT.csv and OUT.md after each. Returns all rows.

    Raises: DataError where nothing is unseen, or a name in `only` is unknown.
    """
    dataset, out, data = Path(dataset), Path(out), Dataset(dataset)
    splits = [s for s in ("test", "beyond") if data.split(s)]
    if not splits:
        raise DataError(f"{dataset} has no test or beyond trajectories; make the data set with some.")
    settings = settings or Settings()
    every = variants(settings)
    if unknown := set(only or ()) - set(every):
        raise DataError(f"There is no variant {', '.join(sorted(unknown))}; there are: {'; '.join(every)}.")
    rows = _kept(out.with_suffix(".csv"), every)
    for name, variant in every.items():
        if (only and name not in only) or (variant.warm and water is None):
            continue
        warm_start, source = None, every[variant.of] if variant.of else variant
        if variant.warm:
            warm_start = _folder(out, "water")
            _trained(Path(water or ""), every[REFERENCE], warm_start, None)
        figures = _trained(dataset, source, _folder(out, variant.of or name), warm_start)
        engine = _engine(out, name, variant)
        rows = [r for r in rows if r["variant"] != name]
        for split in splits:
            cost = {name: figures[name] for name in COSTS if name in figures}
            if "steps" in cost:  # of the processor, so that what else runs on the machine does not count
                cost["cpu_s_per_1000_steps"] = round(6e4 * cost["cpu_minutes"] / max(cost["steps"], 1), 1)
            rows.append({"variant": name, "split": split, **cost, **judge(engine, data, split)})
            logging.getLogger(__name__).info("%s", rows[-1])
        rows.sort(key=lambda r: list(every).index(r["variant"]))
        _write(out, rows, settings, command)
    return rows


def _kept(path: Path, every: dict[str, Variant]) -> list[dict[str, Any]]:
    if not path.is_file():
        return []
    with path.open(newline="") as lines:
        return [row for row in csv.DictReader(lines) if row["variant"] in every]


def _write(out: Path, rows: list[dict[str, Any]], settings: Settings, command: str) -> None:
    with atomic_path(out.with_suffix(".csv")) as beside, beside.open("w", newline="") as lines:
        writer = csv.DictWriter(lines, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    text = ["# Ablation of liquids", "", f"`{command}`", ""]
    text += [
        f"Node form: {settings.steps} steps of {settings.batch} graph(s), {settings.passes} passes, width "
        f"{settings.width}, graph radius {settings.liquid.cutoff:g} spacings, noise {settings.noise:g}. The first row",
        "is the reference; every other row of the node form changes one choice of it. Whole rollouts",
        "from the true first frame; errors",
        "in percent as in DESIGN 6 (100: a picture in which nothing moves), energy is its increment since the first",
        "frame; `kinetic_at_end_ratio` is the median of predicted over true kinetic energy in the last frame.",
        "Seconds are of the processor; milliseconds on one core, as they were with whatever else ran.",
        "",
    ]
    text += ["| " + " | ".join(COLUMNS) + " |", "|" + " --- |" * len(COLUMNS)]
    text += ["| " + " | ".join(str(row.get(c, "")) for c in COLUMNS) + " |" for row in rows]
    with atomic_path(out.with_suffix(".md")) as beside:
        beside.write_text("\n".join(text) + "\n")


def main() -> int:
    """Command line; one clear sentence where something is missing."""
    parser = argparse.ArgumentParser(prog="python -m zsdt.evaluation.liquid_ablation", description=__doc__)
    parser.add_argument("dataset")
    parser.add_argument("out")
    parser.add_argument("--water")
    parser.add_argument("--steps", type=int, default=Settings.steps)
    parser.add_argument("--only", nargs="+")
    words = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    command = " ".join(["python -m zsdt.evaluation.liquid_ablation", *map(shlex.quote, sys.argv[1:])])
    try:
        ablate(words.dataset, words.out, words.water, Settings(steps=words.steps), words.only, command)
    except ZsdtError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
