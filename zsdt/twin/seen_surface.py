"""A seen surface as the twin of a glass takes it, and what it says of the twin."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from zsdt.scene import VesselShape

MOST_LEAN = 0.4  # of a wall over the liquid, m/m


@runtime_checkable
class Profile(Protocol):
    """A seen surface: places [c, 2] m (x, y) in the vessel, height [c] m, seen [c].

    It may also have `climb` [c]: by how much each line of sight rises per way along y. What is seen is then the highest
    line that just touches the liquid, wherever it does: a hump in the middle hides the far wall.
    """

    @property
    def places(self) -> Any: ...

    @property
    def height(self) -> Any: ...

    @property
    def seen(self) -> Any: ...


@dataclass(frozen=True)
class SurfaceInnovation:
    """What a seen surface said. distance [c] m: seen less predicted height, NaN where not seen; taken [c]: which places
    were believed; rejected: whether the whole surface was impossible; scatter: of what no correction explains, over the
    noise told; viscosity: over the told one, as estimated; level [m]: by how much seen heights are thought to be off as
    a whole; work [J]: of the correction on the liquid; whitened: the normalised innovation (`Fit.whitened`)."""

    distance: Float[np.ndarray, " c"]
    taken: Bool[np.ndarray, " c"]
    rejected: bool = False
    scatter: float = float("nan")
    viscosity: float = 1.0
    level: float = 0.0
    work: float = 0.0
    whitened: Float[np.ndarray, " numbers"] = field(default_factory=lambda: np.zeros(0))


def leans_over(shape: VesselShape, height: Float[np.ndarray, " c"]) -> Bool[np.ndarray, " c"]:
    """Whether the wall leans over the liquid at heights [m]: there it is pressed against the wall, and no surface."""
    heights, radii = np.array(shape.heights), np.array(shape.radii)
    slope = np.diff(radii) / np.diff(heights)
    piece = np.clip(np.searchsorted(heights, height, side="right") - 1, 0, len(slope) - 1)
    return slope[piece] < -MOST_LEAN
