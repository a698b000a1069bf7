"""Which trained parts a twin takes: those of the package or those of the stages of its experiment."""

from __future__ import annotations

from pathlib import Path

from pipelines.kinds import Kind
from pipelines.options import TwinParts, Weights
from zsdt.errors import DataError
from zsdt.shipped import PARTS, WEIGHTS, TwinWeights, shipped


def _trained(parts: TwinParts) -> list[str]:
    return [name for name in PARTS if getattr(parts, name) is Weights.trained]


def inputs_of(parts: TwinParts) -> tuple[str, ...]:
    """Stages that must run before a twin can use the parts."""
    return tuple(f"train_{name}" for name in _trained(parts))


def files_of(parts: TwinParts, kind: Kind) -> list[Path]:
    """Shipped files that are used: their contents belong to the key of what is made with them."""
    folders = [WEIGHTS / kind.weights / name for name in PARTS if name not in _trained(parts)]
    return sorted(path for folder in folders for path in folder.rglob("*") if path.is_file())


def twin_weights(parts: TwinParts, inputs: dict[str, Path], kind: Kind) -> TwinWeights:
    """Folders of the parts. Raises: DataError where the experiment does not train one, or nothing is shipped."""
    return TwinWeights(**{name: _folder_of(name, parts, inputs, kind) for name in PARTS})


def vision_of(parts: TwinParts, inputs: dict[str, Path], kind: Kind) -> Path:
    """Folder of the segmentation. Raises: as `twin_weights`."""
    return _folder_of("vision", parts, inputs, kind)


def _folder_of(name: str, parts: TwinParts, inputs: dict[str, Path], kind: Kind) -> Path:
    if getattr(parts, name) is Weights.shipped:
        return shipped(kind.weights, name)
    if f"train_{name}" not in inputs:
        raise DataError(f"This experiment has no stage train_{name}; take the shipped weights of {name} instead.")
    return inputs[f"train_{name}"]
