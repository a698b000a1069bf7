"""Stage `evaluate`: every method on the held-out trajectories, in one process, with tables and recordings."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from omegaconf import OmegaConf
from tqdm import tqdm

from pipelines.options import Baseline
from pipelines.stages import Stage
from pipelines.store import MANIFEST, plain
from pipelines.train_tignn import SUBSTEPS
from zsdt.tignn.engine import Engine, load_engine

# What the table of a sweep shows of a method; those of the other kind of body are left out.
FIGURES = (
    "displacement_rrmse_mean",
    "position_rrmse_mean",
    "velocity_rrmse_mean",
    "stress_rrmse_mean",
    "energy_increment_rrmse_mean",
    "centroid_rrmse_mean",
    "frequency_error_mean",
    "damping_error_mean",
    "level_rmse_mean",
    "ms_p50",
    "graph_ms_mean",
)
PSI_INI_FIGURES = (
    "axial_stress_rmse",
    "axial_stress_rrmse",
    "von_mises_rmse",
    "von_mises_rrmse",
    "stress_rrmse",
    "velocity_rmse",
    "velocity_x_rmse",
    "velocity_y_rmse",
    "velocity_z_rmse",
    "velocity_rrmse",
    "internal_energy_rmse",
    "internal_energy_rrmse",
)


def run(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Writes metrics, curves, summaries and recordings; returns what the table of a sweep shows."""
    from zsdt.evaluation.evaluate import evaluate

    engines = engines_of(cfg, inputs)
    configs = {role: _config_of(folder) for role, folder in inputs.items()}
    with tqdm(desc="evaluate", unit="rollout") as bar:

        def progress(done: int, total: int, what: str) -> None:
            bar.total = total
            bar.set_postfix_str(what, refresh=False)
            bar.update(done - bar.n)

        summary = evaluate(
            inputs["dataset"], engines, cfg.evaluation, out, config_text=OmegaConf.to_yaml(configs), progress=progress
        )
    methods = figures_of(summary["rows"])
    first = next(iter(engines))
    figures: dict[str, Any] = {
        "first": first,
        "objective": methods[first]["displacement_rrmse"],
        "engine": methods.pop(first),
        "others": methods,
        "threads": summary["threads"],
    }
    if "train_psi_ini" in inputs:
        figures["psi_ini"] = _judge_psi_ini(cfg, inputs["train_psi_ini"], inputs["dataset"], out)
    return figures


def engines_of(cfg: SimpleNamespace, inputs: dict[str, Path]) -> dict[str, Engine]:
    """The trained engine first, then its rivals, then what needs no training."""
    from zsdt.interop.inference import with_backend

    engines: dict[str, Engine] = {}
    for role, folder in inputs.items():
        stage, _, rival = role.partition(".")
        if stage == "train_tignn":
            engines[rival or _name_of(folder)] = with_backend(load_engine(folder), cfg.inference)
    if cfg.evaluation.from_psi_ini and "train_psi_ini" in inputs and "train_tignn" in inputs:
        from zsdt.evaluation.baselines import FromPsiIni
        from zsdt.tignn.psi_ini import load

        first = with_backend(load_engine(inputs["train_tignn"]), cfg.inference)
        engines[f"{next(iter(engines))}_from_psi_ini"] = FromPsiIni(first, load(inputs["train_psi_ini"]))
    return engines | {kind.value: baseline(kind) for kind in cfg.baselines}


def baseline(kind: Baseline) -> Engine:
    """A method that needs no training."""
    from zsdt.evaluation.baselines import InertiaBaseline, StaticBaseline
    from zsdt.fluid.engine import CoarseSph
    from zsdt.solid.engine import CoarseFem

    made: dict[Baseline, Callable[[], Engine]] = {
        Baseline.static: StaticBaseline,
        Baseline.inertia: InertiaBaseline,
        Baseline.fem_5cm: lambda: CoarseFem(mesh=0.05),
        Baseline.fem_10cm: lambda: CoarseFem(mesh=0.10),
        Baseline.full_sph: lambda: CoarseSph(ratio=1.0),
        Baseline.coarse_sph: lambda: CoarseSph(ratio=1.5),
        Baseline.coarser_sph: lambda: CoarseSph(ratio=2.0),
    }
    return made[kind]()


def _config_of(folder: Path) -> Any:
    manifest = folder / MANIFEST
    return json.loads(manifest.read_text())["config"] if manifest.is_file() else {"folder": folder.name}


def _name_of(folder: Path) -> str:
    """tignn_cell, tignn_particle, tignn_exact, tignn_soft, seed_literal or black_box."""
    card = json.loads((folder / "engine.json").read_text())
    if card["kind"] == "seed":
        return "seed_literal"
    if card["kind"] in SUBSTEPS:
        return f"tignn_{card['kind']}"
    bracket = _config_of(folder).get("tignn", {}).get("bracket", card["kind"])
    return "black_box" if bracket == "none" else f"tignn_{bracket}"


def figures_of(rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Means over the splits of the summary: ``<method>.<figure>`` and ``<method>.<regime>.<figure>``."""
    found: dict[str, dict[str, Any]] = {}
    for row in rows:
        found.setdefault(row["method"], {})
    for method, figures in found.items():
        mine = [row for row in rows if row["method"] == method]
        figures |= _means(mine)
        regimes = sorted({row["regime"] for row in mine})
        if len(regimes) > 1:
            figures |= {regime: _means([row for row in mine if row["regime"] == regime]) for regime in regimes}
    return plain(found)


def _means(rows: list[dict[str, Any]]) -> dict[str, float]:
    means = {}
    for name in (name for name in FIGURES if any(name in row for row in rows)):
        pairs = [(row[name], row["trajectories"]) for row in rows if name in row]
        count = sum(weight for _, weight in pairs)
        mean = sum(value * weight for value, weight in pairs) / count if count else math.nan
        means[name.removesuffix("_mean")] = float(mean)
    return means


def _judge_psi_ini(cfg: SimpleNamespace, network: Path, dataset: Path, out: Path) -> dict[str, Any]:
    """Errors of the first stress on the evaluated trajectories; one row each in `psi_ini.csv`."""
    from zsdt.evaluation.initial_fields import evaluate_psi_ini
    from zsdt.evaluation.tables import write_csv
    from zsdt.tignn.psi_ini import load

    judged = evaluate_psi_ini(dataset, load(network), cfg.evaluation)
    write_csv(out / "psi_ini.csv", judged["per_trajectory"])
    weights = [row["trajectories"] for row in judged["rows"]]
    names = [name for name in PSI_INI_FIGURES if f"{name}_mean" in judged["rows"][0]]
    return {
        name: sum(w * row[f"{name}_mean"] for w, row in zip(weights, judged["rows"], strict=True)) / sum(weights)
        for name in names
    }


STAGE = Stage(
    "evaluate",
    3,
    ("evaluation", "baselines", "inference"),
    run,
    inputs=("dataset", "train_psi_ini", "train_tignn"),
)
