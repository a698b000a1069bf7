"""Trained weights that come with the package, so that a twin runs without any training.

`zsdt/weights/<scene>/<part>/` holds what the stage of that part wrote; `MODEL_CARD.md` beside them says what they were
trained on and how well they do. `python -m pipelines.ship` makes both from finished artifacts.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from zsdt.errors import DataError

WEIGHTS = Path(__file__).parent / "weights"
PARTS = ("tignn", "psi_ini", "vision")
LARGEST = 2_000_000  # bytes of a part


@dataclass(frozen=True)
class TwinWeights:
    """Folders of the trained parts of a twin."""

    tignn: Path
    psi_ini: Path | None
    vision: Path


def shipped(scene: str, part: str) -> Path:
    """Folder of the shipped `part` (tignn, psi_ini, vision) of a `scene` (foam_beam, glycerin_glass).

    Raises: DataError where nothing of the kind is shipped.
    """
    folder = WEIGHTS / scene / part
    if not folder.is_dir():
        there = ", ".join(sorted(str(p.relative_to(WEIGHTS)) for p in WEIGHTS.glob("*/*") if p.is_dir())) or "none"
        raise DataError(f"No weights of {scene}/{part} come with this package (there are: {there}); train them.")
    return folder
