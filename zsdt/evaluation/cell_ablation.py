"""What each choice of the sub-step form brings.

`python -m zsdt.evaluation.cell_ablation DATASET ENGINE OUT [NAME=ENGINE ...]`

DATASET: folder of a data set; ENGINE: artifact of a trained cell engine with its `stages`; OUT: path without suffix;
NAME=ENGINE: engines that were trained with other options. OUT.csv and OUT.md are written, one row per variant and
regime, over the unseen sizes (splits test and beyond).
"""

from __future__ import annotations

import csv
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from zsdt.errors import DataError, RunRejected, ZsdtError
from zsdt.evaluation.baselines import StaticBaseline
from zsdt.evaluation.metrics import field_errors
from zsdt.evaluation.modal import frequencies
from zsdt.evaluation.stability import stability_check
from zsdt.files import atomic_path
from zsdt.solid.engine import CoarseFem
from zsdt.tignn.cell_energy import CellStart, nominal_constants
from zsdt.tignn.cell_engine import CellEngine, load_cell_engine
from zsdt.tignn.cell_train import STAGES
from zsdt.tignn.engine import Engine, roll_out
from zsdt.trajectory import Dataset, DatasetEntry

COLUMNS = (
    "variant", "regime", "beams", "displacement_percent", "worst_displacement", "q_percent", "velocity_percent",
    "stress_percent", "worst_stress", "axial_percent", "frequency_percent", "ms_per_frame", "ms_p95", "diverged",
    "diverged_in_1000",
)  # fmt: skip


def variants(folder: Path, card: tuple[float, float, float, float] | None) -> dict[str, Engine]:
    """Engines to compare, by name: stages of the training, then the finished engine with one choice changed."""
    final = load_cell_engine(folder)

    def changed(**choices: Any) -> CellEngine:
        options = replace(final.options, **choices)
        return CellEngine(final.constants, options, final.correction, final.readout)

    found: dict[str, Engine] = {"static picture": StaticBaseline()}
    for mesh in (0.05,):
        found[f"FEM {100 * mesh:g} cm (material known)"] = CoarseFem(mesh)
    if card is not None:
        found["cell energy, material known, nothing learned"] = CellEngine(nominal_constants(*card), final.options)
    for stage in STAGES:
        if (folder / "stages" / stage / "engine.json").is_file():
            found[f"learned up to: {stage}"] = load_cell_engine(folder / "stages" / stage)
    found["final, start=residual"] = changed(start=CellStart.residual)
    found["final, start=plain"] = changed(start=CellStart.plain)
    found["final, first stress not carried"] = changed(anchor_stress=False)
    plain = changed(anchor_stress=False)
    found["final, first stress not carried, plain read-out"] = CellEngine(
        plain.constants, plain.options, plain.correction
    )
    found["final, no memory"] = changed(memory=False)
    found["final, half the sub-step"] = changed(safety=0.5 * final.options.safety)
    for factor in (1.3, 1.6, 2.0):
        found[f"final, sub-step at {factor:g} times the limit of a cell"] = changed(safety=factor)
    return found


def judge(engine: Engine, data: Dataset, entries: list[DatasetEntry], long_check: bool) -> dict[str, Any]:
    """Mean and worst errors [%] of `engine` over `entries` of one regime."""
    rows: list[dict[str, float]] = []
    diverged, diverged_long, milliseconds = 0, 0, []
    for number, entry in enumerate(entries):
        trajectory = data.read(entry)
        free = ~trajectory.body.clamped
        try:
            rollout = roll_out(engine, trajectory)
        except RunRejected:
            diverged += 1
            continue
        errors = field_errors(rollout.fields, trajectory.fields, free)
        if rollout.diverged_at is not None or not errors["displacement_rrmse"] < 10:
            diverged += 1
            continue
        place = (trajectory.body, rollout.fields["position"], trajectory.fields["position"], trajectory.load)
        ours, true = frequencies(*place)
        errors["frequency"] = abs(ours / true - 1) if np.isfinite(true) else np.nan
        rows.append(errors)
        milliseconds.append(rollout.milliseconds[3:])
        if long_check and number < 2 and stability_check(engine, trajectory, 1000) is not None:
            diverged_long += 1
    if not rows:
        return {"beams": len(entries), "diverged": diverged}

    def mean(name: str) -> float:
        values = [r[name] for r in rows if not np.isnan(r[name])]
        return round(100 * float(np.mean(values)), 3) if values else float("nan")

    def worst(name: str) -> float:
        return round(100 * max(r[name] for r in rows), 3)

    clock = np.concatenate(milliseconds)
    return {
        "beams": len(entries),
        "displacement_percent": mean("displacement_rrmse"),
        "worst_displacement": worst("displacement_rrmse"),
        "q_percent": mean("position_rrmse"),
        "velocity_percent": mean("velocity_rrmse"),
        "stress_percent": mean("stress_rrmse"),
        "worst_stress": worst("stress_rrmse"),
        "axial_percent": mean("axial_stress_rrmse"),
        "frequency_percent": mean("frequency"),
        "ms_per_frame": round(float(np.median(clock)), 3),
        "ms_p95": round(float(np.percentile(clock, 95)), 3),
        "diverged": diverged,
        "diverged_in_1000": diverged_long if long_check else "",
    }


def ablate(
    dataset: str | Path, folder: str | Path, out: str | Path, others: dict[str, str], command: str
) -> list[dict[str, Any]]:
    """Judges all variants, and engines of other trainings (name -> folder); writes OUT.csv and OUT.md.

    Raises: DataError where nothing is unseen.
    """
    data = Dataset(dataset)
    unseen = data.split("test", "beyond")
    if not unseen:
        raise DataError(f"{dataset} has no test or beyond trajectories; make the data set with some.")
    material = data.read(unseen[0]).body.material
    card = None if material is None else (material.bulk, material.shear, material.g1, material.tau)
    rows = []
    engines = variants(Path(folder), card)
    engines.update({name: load_cell_engine(Path(other)) for name, other in others.items()})
    for name, engine in engines.items():
        for regime in ("hand", "dynamic"):
            entries = [e for e in unseen if e.regime == regime]
            if entries:
                long_check = name == "learned up to: readout" or name.startswith("final, sub-step")
                rows.append({"variant": name, "regime": regime, **judge(engine, data, entries, long_check)})
                print({k: v for k, v in rows[-1].items() if v != ""}, flush=True)
    _write(Path(out), rows, command)
    return rows


def _write(out: Path, rows: list[dict[str, Any]], command: str) -> None:
    with atomic_path(out.with_suffix(".csv")) as beside, beside.open("w", newline="") as lines:
        writer = csv.DictWriter(lines, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
    text = ["# Ablation of the sub-step form", "", f"`{command}`", ""]
    text += [
        "Means over the trajectories of unseen sizes (splits test and beyond), whole rollouts from the first frame; ",
        "errors in percent as in DESIGN 6, milliseconds per frame on one core with the read-out.",
        "",
        "`learned up to`: stages of the training one after the other (start: constants deliberately off; statics:",
        "fitted to the sag at rest; motion: to rollouts; boundary: factors for cells at clamp and surface; correction:",
        "network; readout: stress). `material known, nothing learned`: the card of the data, weights 1, lumped mass.",
        "`final`: the finished engine with one choice changed and nothing learned again. The first stress is carried",
        "along with the body in all rows that do not say otherwise; FEM and cell engine both start from own rest.",
        "",
    ]
    text += ["| " + " | ".join(COLUMNS) + " |", "|" + " --- |" * len(COLUMNS)]
    text += ["| " + " | ".join(str(row.get(c, "")) for c in COLUMNS) + " |" for row in rows]
    with atomic_path(out.with_suffix(".md")) as beside:
        beside.write_text("\n".join(text) + "\n")


def main() -> int:
    """Command line; one clear sentence where something is missing."""
    words = sys.argv[1:]
    if len(words) < 3 or not all("=" in w for w in words[3:]):
        print(__doc__)
        return 2
    try:
        others = dict(w.split("=", 1) for w in words[3:])
        command = " ".join(["python -m zsdt.evaluation.cell_ablation", *map(shlex.quote, words)])
        ablate(words[0], words[1], words[2], others, command)
    except ZsdtError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
