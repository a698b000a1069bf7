"""A folder of trained weights as one ONNX file, checked against torch before anybody relies on it."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from zsdt.errors import DataError, OptionError
from zsdt.interop.onnx_engine import load_onnx_engine, rollout_difference
from zsdt.interop.onnx_files import TOLERANCE, OnnxFile, difference, made_up, write_onnx
from zsdt.interop.onnx_networks import (
    LiquidPsiIniOnnx,
    LiquidStepNetwork,
    MaskNetwork,
    SolidPsiIniNetwork,
    StepNetwork,
    card_of,
)
from zsdt.perception.glass_segmentation import YOLO_CARD
from zsdt.perception.unet_weights import CARD, load_unet, unet_card
from zsdt.tignn import liquid_engine, node_engine, psi_ini
from zsdt.tignn.engine import load_engine, roll_out
from zsdt.tignn.psi_ini_liquid import LiquidPsiIni
from zsdt.trajectory import Trajectory

SEED = "seed"  # kind of the seed's network to the letter
COMPILED = {
    "cell": "many small steps of a compiled element loop inside a frame, with a few learned constants in it",
    "particle": "many small steps of a compiled particle loop inside a frame, with learned pair profiles in it",
}
CHECKS = ((3, 2, 2), (5, 3, 4))  # bricks of the made-up bodies, other sizes than the traced one


@dataclass
class OnnxReport:
    """What was exported: kind, size of the file [bytes], and the largest differences to torch by output: one call on
    made-up inputs of other sizes, and a whole rollout where there was one (name, frames)."""

    kind: str
    size: int
    call: dict[str, float]
    rollout: dict[str, float] = field(default_factory=dict)
    trajectory: str = ""
    frames: int = 0

    @property
    def worst(self) -> float:
        """The largest of all differences."""
        return max([*self.call.values(), *self.rollout.values()])


def export_onnx(
    folder: str | os.PathLike[str],
    path: str | os.PathLike[str],
    trajectory: Trajectory | None = None,
    frames: int | None = None,
) -> OnnxReport:
    """Writes the network in `folder` to `path` and checks it with ONNX Runtime, by a call and by a rollout of
    `trajectory` over `frames` frames (all by default) where the network advances a state.

    The folder holds what a training stage wrote (`engine.json`, `psi_ini.json` or `unet.json`).

    Raises: OptionError where the network is no ONNX graph, or a package is missing; DataError where the folder holds
    no network, or the file does not give the same numbers to `TOLERANCE` (it is then removed).
    """
    network = exportable(folder)
    write_onnx(path, network, card_of(network))
    file = OnnxFile(path)
    calls = [difference(file, network, made_up(network, counts, seed=k)) for k, counts in enumerate(CHECKS, 1)]
    call = {name: max(found[name] for found in calls) for name in calls[0]}
    report = OnnxReport(network.kind, Path(path).stat().st_size, call)
    if trajectory is not None and isinstance(network, StepNetwork | LiquidStepNetwork):
        ours = roll_out(load_engine(Path(folder)), trajectory, frames)
        theirs = roll_out(load_onnx_engine(path), trajectory, frames)
        report.rollout = dict(rollout_difference(ours, theirs))
        report.trajectory, report.frames = trajectory.name, len(ours.milliseconds) + 1
    if not report.worst <= TOLERANCE:
        os.unlink(path)
        raise DataError(
            f"The ONNX file of {folder} differs from torch by {report.worst:.2g} of the largest value, more than "
            f"{TOLERANCE:g}, and was removed; rollouts that diverge do so: choose a trained network or fewer frames."
        )
    return report


def exportable(folder: str | os.PathLike[str]) -> Any:
    """The network of a folder of trained weights, ready for `write_onnx`.

    Raises: DataError where the folder holds none; OptionError where it is no ONNX graph.
    """
    folder = Path(folder)
    if (folder / "engine.json").is_file():
        return _engine_network(folder)
    if (folder / "psi_ini.json").is_file():
        found = psi_ini.load(folder)
        if isinstance(found, LiquidPsiIni):
            return LiquidPsiIniOnnx(found.network)
        return SolidPsiIniNetwork(found.network)
    if (folder / CARD).is_file():
        return MaskNetwork(load_unet(folder, unet_card(folder).get("outputs", 1)))
    if (folder / YOLO_CARD).is_file():
        raise OptionError(f"{folder} holds a YOLO; its own package writes ONNX: `yolo export format=onnx model=...`.")
    raise DataError(
        f"{folder} holds no trained network (no engine.json, psi_ini.json or {CARD}); name a folder that a training "
        "stage wrote, such as outputs/artifacts/train_tignn/KEY or zsdt/weights/foam_beam/vision."
    )


def _engine_network(folder: Path) -> StepNetwork | LiquidStepNetwork:
    try:
        kind = json.loads((folder / "engine.json").read_text())["kind"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"The card engine.json in {folder} is broken ({error}); train the engine again.") from error
    if kind in COMPILED:
        raise OptionError(
            f"The engine in {folder} is of the sub-step form '{kind}': {COMPILED[kind]}. That is no network and no "
            "ONNX graph; run it with zsdt (`zsdt.tignn.engine.load_engine`), or train tignn.form=node and export that."
        )
    if kind == node_engine.KIND:
        return StepNetwork(node_engine.load_model(folder))
    if kind == liquid_engine.KIND:
        return LiquidStepNetwork(liquid_engine.load_model(folder))
    if kind == SEED:
        raise OptionError(
            f"The engine in {folder} is the seed's network to the letter, which is here for `make bench` alone and is "
            "not exported; train tignn.form=node and export that."
        )
    raise DataError(f"The engine in {folder} is of the unknown kind '{kind}'; update zsdt or train it again.")
