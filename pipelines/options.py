"""Options of the frame itself; those of the rooms lie in the rooms."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Baseline(Enum):
    """A method that needs no training.

    static: a picture in which nothing moves. inertia: straight flight. fem_5cm, fem_10cm: the ground truth of a beam
    on a coarser mesh. full_sph, coarse_sph, coarser_sph: the ground truth of a liquid with 1, 1.5 and 2 times the
    spacing, from particles of its own.
    """

    static = "static"
    inertia = "inertia"
    fem_5cm = "fem_5cm"
    fem_10cm = "fem_10cm"
    full_sph = "full_sph"
    coarse_sph = "coarse_sph"
    coarser_sph = "coarser_sph"


@dataclass
class Machine:
    """Where and how fast, never what: nothing in here is part of an artifact's key.

    outputs: folder of all that a run writes. workers: processes that make data. threads: of one process.
    """

    outputs: str = "outputs"
    workers: int = 2
    threads: int = 1
