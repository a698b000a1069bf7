"""What a scene may cost and how wrong it may be."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from zsdt.errors import OptionError


class Motion(StrEnum):
    """How a beam is loaded: slowly by a hand, or dynamically (release, impulse, free vibration); any: not known."""

    any = "any"
    hand = "hand"
    dynamic = "dynamic"


@dataclass
class Budget:
    """error: largest RRMSE [-] of every field that the scene wants (0.1 is 10 %); frame_ms: what a frame may take on
    average [ms], on one thread of this machine. One of them at least. length, height [m]: of a beam as it will be seen,
    0: not known before the first picture. volume [m3] of a liquid, 0: not known. motion: of a beam, if it is known.
    speed: of this machine over that of the data, 0: measured now (a quarter of a second).
    """

    error: float | None = None
    frame_ms: float | None = None
    length: float = 0.0
    height: float = 0.0
    volume: float = 0.0
    motion: Motion = Motion.any
    speed: float = 0.0

    def __post_init__(self) -> None:
        for name, value in (("error", self.error), ("frame_ms", self.frame_ms)):
            if value is not None and value <= 0:
                raise OptionError(f"budget.{name} must be positive.")
        if min(self.length, self.height, self.volume, self.speed) < 0:
            raise OptionError("length, height, volume and speed of a budget must not be negative.")

    @property
    def is_set(self) -> bool:
        """Whether anything is asked for."""
        return self.error is not None or self.frame_ms is not None
