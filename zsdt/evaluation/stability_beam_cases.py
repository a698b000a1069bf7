"""Hard cases of beams, as data: what hangs at the clamp, what pushes it, how long, and what is wrong with what is told.

A case is reproducible by its name. Loads are dead forces on the nodes of the graph, linear between frames, the same for
the solver, the network and (unknown to it) the twin.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from jaxtyping import Float

from zsdt.scene import BeamShape, Foam
from zsdt.solid.loads import bending_frequency

HAND_HORIZON = 102  # frames of the longest trajectories that the shipped network was trained on (1.7 s at 60 Hz)
FPS = 60.0


class Place(StrEnum):
    """Where the force acts: all of the tip; its edge at large y; a couple that twists the tip about the axis; the side
    at half the length, across the picture."""

    tip = "tip"
    edge = "edge"
    couple = "couple"
    side = "side"


class Course(StrEnum):
    """How the force goes over time.

    none; hand: up within 0.5 s, held, gone within 0.5 s; release: up within 0.5 s and let go within one frame; held:
    there from the first frame on, gone within one; impulse: there in a single frame; resonance: a sine at the first
    bending frequency; slow: a sine of 0.5 Hz.
    """

    none = "none"
    hand = "hand"
    release = "release"
    held = "held"
    impulse = "impulse"
    resonance = "resonance"
    slow = "slow"


class Spoilt(StrEnum):
    """What is wrong with the state at one frame: a coordinate is not a number, a node is thrown away by half of the
    beam's length; or at the first: stress of the size of the load's own, at random."""

    nothing = "nothing"
    nan = "nan"
    outlier = "outlier"
    random_stress = "random_stress"


@dataclass(frozen=True)
class BeamCase:
    """A beam, its load, and what the network and the twin are told about it.

    size_cm: length, width, depth; pitch_cm of the graph, mesh_cm of the solver; newtons: of the force; frames at `fps`;
    young: factor of Young's modulus as the network and the twin are told it; gravity: factor; spoilt: of the state, at
    `spoilt_frame`. normal: whether this is one of the cases that say how large a normal error is.
    """

    name: str
    what: str
    size_cm: tuple[float, float, float] = (40.0, 20.0, 15.0)
    pitch_cm: float = 5.0
    mesh_cm: float = 2.5
    place: Place = Place.tip
    newtons: float = 3.0
    course: Course = Course.hand
    frames: int = 90
    young: float = 1.0
    gravity: float = 1.0
    spoilt: Spoilt = Spoilt.nothing
    spoilt_frame: int = 10
    normal: bool = False
    material: Foam = field(default_factory=Foam)

    @property
    def kind(self) -> str:
        """What the case is about."""
        return "beam"

    @property
    def cost(self) -> float:
        """About how long it takes, to begin with the longest."""
        return self.frames * float(np.prod(self.size_cm)) / self.mesh_cm**4

    @property
    def shape(self) -> BeamShape:
        """Length, width, depth [m]."""
        length, width, depth = (round(cm / 100.0, 6) for cm in self.size_cm)
        return BeamShape(length, width, depth)

    @property
    def told(self) -> Foam:
        """The material that network and twin are told."""
        return replace(self.material, young=self.young * self.material.young)

    def factors(self) -> Float[np.ndarray, " frames"]:
        """Share of the force at each frame."""
        time = np.arange(self.frames) / FPS
        if self.course is Course.hand:
            last = time[-1]
            up = np.clip((time - 0.1) / 0.5, 0.0, 1.0)
            down = np.clip((time - max(last - 0.6, 0.6)) / 0.5, 0.0, 1.0)
            return 0.5 * (1.0 - np.cos(np.pi * up)) * 0.5 * (1.0 + np.cos(np.pi * down))
        if self.course is Course.release:
            return np.where(time < 0.8, 0.5 * (1.0 - np.cos(np.pi * np.clip((time - 0.1) / 0.5, 0.0, 1.0))), 0.0)
        if self.course is Course.held:
            return (time < 0.3).astype(float)
        if self.course is Course.impulse:
            return (np.arange(self.frames) == 6).astype(float)
        if self.course is Course.resonance:
            return np.sin(2.0 * np.pi * bending_frequency(self.shape, self.material) * time)
        if self.course is Course.slow:
            return np.sin(np.pi * time)
        return np.zeros(self.frames)

    def force(self, points: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "nodes 3"]:
        """The force [N] on the nodes of the solver's mesh where its factor is one."""
        return self.newtons * pattern(points, self.place, self.mesh_cm / 100.0)


def pattern(points: Float[np.ndarray, "nodes 3"], place: Place, edge: float) -> Float[np.ndarray, "nodes 3"]:
    """Forces of one newton in all on the nodes [m] of a brick of elements of `edge` [m]; a couple has one newton down
    on one edge of the tip and one up on the other."""
    x, y, _ = points.T
    tip = x > x.max() - 1e-9
    force = np.zeros_like(points)
    far, near = tip & (y > y.max() - 1e-9), tip & (y < y.min() + 1e-9)
    if place is Place.tip:
        force[tip, 2] = -1.0 / tip.sum()
    elif place is Place.edge:
        force[far, 2] = -1.0 / far.sum()
    elif place is Place.couple:
        force[far, 2], force[near, 2] = -1.0 / far.sum(), 1.0 / near.sum()
    else:
        chosen = (np.abs(x - 0.5 * x.max()) < 1.01 * edge) & (y < y.min() + 1e-9)
        force[chosen, 1] = 1.0 / chosen.sum()
    return force


SMALL = (40.0, 10.0, 10.0)
BEAM_CASES = (
    BeamCase("normal_hand", "3 N by hand on the tip of a beam of a trained size", normal=True),
    BeamCase("normal_release", "2 N let go", newtons=2.0, course=Course.release, normal=True),
    BeamCase("normal_small", "0.5 N by hand on a thin beam", size_cm=SMALL, newtons=0.5, normal=True),
    BeamCase("horizon_10x", "10 x the training horizon, slow sine", SMALL, newtons=0.4, course=Course.slow,
             frames=10 * HAND_HORIZON),
    BeamCase("frames_10000", "10,000 frames, slow sine", SMALL, newtons=0.4, course=Course.slow, frames=10_000),
    BeamCase("load_3x", "3 x the largest trained load", newtons=15.0),
    BeamCase("load_10x", "10 x the largest trained load", newtons=50.0),
    BeamCase("impulse", "5 N in a single frame", newtons=5.0, course=Course.impulse),
    BeamCase("resonance", "sine at the first bending frequency", newtons=1.0, course=Course.resonance, frames=180),
    BeamCase("slender", "80 x 10 x 10 cm", (80.0, 10.0, 10.0), newtons=0.1),
    BeamCase("stubby", "35 x 40 x 40 cm", (35.0, 40.0, 40.0), newtons=5.0),
    BeamCase("pitch_half", "graph of half the trained pitch", SMALL, pitch_cm=2.5, newtons=0.5),
    BeamCase("pitch_double", "graph of twice the trained pitch", (40.0, 20.0, 20.0), pitch_cm=10.0),
    BeamCase("twist", "couple of 3 N that twists the tip", place=Place.couple),
    BeamCase("off_axis", "3 N on one edge of the tip", place=Place.edge),
    BeamCase("sideways", "3 N across the picture, out of its plane", place=Place.side),
    BeamCase("release", "5 N let go", newtons=5.0, course=Course.release),
    BeamCase("held_at_start", "2 N held in the first frame already, then let go", newtons=2.0, course=Course.held),
    BeamCase("at_rest", "nothing happens for 1,000 frames", SMALL, newtons=0.0, course=Course.none, frames=1_000),
    BeamCase("soft_5x", "told a Young's modulus 5 x too low", young=0.2),
    BeamCase("stiff_5x", "told a Young's modulus 5 x too high", young=5.0),
    BeamCase("gravity_off", "weightless", gravity=0.0),
    BeamCase("nan_state", "a coordinate of the state becomes NaN", spoilt=Spoilt.nan),
    BeamCase("outlier_state", "a node of the state is thrown half a length away", spoilt=Spoilt.outlier),
    BeamCase("random_stress", "stress of the first frame is random", spoilt=Spoilt.random_stress, spoilt_frame=0),
)  # fmt: skip
