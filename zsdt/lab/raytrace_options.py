"""How the ray tracer for glasses looks; imports nothing that is optional."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from zsdt.errors import OptionError


class RayVariant(Enum):
    """Which build of Mitsuba casts the rays: `llvm` compiles for the processor and needs LLVM's library on the
    system, `scalar` always runs and is several times slower; `auto` takes the first that works."""

    auto = "auto"
    llvm = "llvm"
    scalar = "scalar"


@dataclass
class RaytraceOptions:
    """How finely the ray tracer looks.

    samples: rays per pixel, shared among the moments of an exposure; depth: surfaces that a ray is followed through;
    angles: columns of the meshes; variant: see `RayVariant`.
    """

    samples: int = 4
    depth: int = 12
    angles: int = 128
    variant: RayVariant = RayVariant.auto

    def __post_init__(self) -> None:
        if self.samples < 1 or self.depth < 2 or self.angles < 16:
            raise OptionError("The ray tracer needs at least 1 sample, a depth of 2 and 16 angles.")
