"""Which trained parts a twin takes: those of the package or those of the stages of its experiment."""

from __future__ import annotations

from pathlib import Path

from pipelines.options import Weights
from zsdt.errors import DataError
from zsdt.evaluation.beam_twin_cases import TwinWeights
from zsdt.shipped import WEIGHTS, shipped

SCENE = "foam_beam"
STAGES = ("train_vision", "train_psi_ini", "train_tignn")


def inputs_of(weights: Weights) -> tuple[str, ...]:
    """Stages that must run before a twin can use the weights."""
    return STAGES if weights is Weights.trained else ()


def files_of(weights: Weights) -> list[Path]:
    """Shipped files, whose contents belong to the key of what is made with them."""
    folder = WEIGHTS / SCENE
    return sorted(p for p in folder.rglob("*") if p.is_file()) if weights is Weights.shipped else []


def twin_weights(weights: Weights, inputs: dict[str, Path]) -> TwinWeights:
    """Folders of the parts. Raises: DataError where the experiment trains no segmentation or nothing is shipped."""
    if weights is Weights.shipped:
        return TwinWeights(shipped(SCENE, "tignn"), shipped(SCENE, "psi_ini"), shipped(SCENE, "vision"))
    if "train_vision" not in inputs:
        raise DataError(
            "This experiment trains no segmentation; add vision=painted_grid or set the weights to shipped."
        )
    return TwinWeights(inputs["train_tignn"], inputs.get("train_psi_ini"), inputs["train_vision"])
