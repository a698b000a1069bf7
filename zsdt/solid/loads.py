"""Load cases: a patch on a face, a force normal to it, and how the force goes over time."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from enum import Enum
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from zsdt.scene import BeamShape, Foam
from zsdt.solid.mesh import FACE_AXES, BrickMesh, Face


class Regime(Enum):
    """How fast a load is: as a hand moves, or fast enough to make the beam swing."""

    hand = "hand"
    dynamic = "dynamic"


@dataclass(frozen=True)
class History:
    """Force over time as a factor of the force of the load case.

    Knots (`times` [s], `levels`) joined by half cosines, constant outside of them; and a sine of `amplitude` with
    `frequency` [Hz] that begins at `sine_start` [s] and grows over its first period.
    """

    kind: str
    times: tuple[float, ...]
    levels: tuple[float, ...]
    amplitude: float = 0.0
    frequency: float = 0.0
    sine_start: float = 0.0

    def __call__(self, time: Float[np.ndarray, " times"]) -> Float[np.ndarray, " times"]:
        """Factor at each time [s]."""
        knots = np.asarray(self.times)
        after = np.clip(np.searchsorted(knots, time, side="right"), 1, len(knots) - 1)
        span = knots[after] - knots[after - 1]
        part = np.clip((time - knots[after - 1]) / span, 0.0, 1.0)
        levels = np.asarray(self.levels)
        value = levels[after - 1] + (levels[after] - levels[after - 1]) * 0.5 * (1.0 - np.cos(math.pi * part))
        if self.amplitude:
            phase = np.maximum(time - self.sine_start, 0.0) * self.frequency
            value = value + self.amplitude * np.minimum(phase, 1.0) * np.sin(2.0 * math.pi * phase)
        return value


@dataclass(frozen=True)
class LoadCase:
    """A force [N] on a patch of a face, as a follower pressure.

    first, second [m]: the patch along the two axes of the face (x before y before z). force > 0 pushes into the
    beam, force < 0 pulls; it is the force on the undeformed patch.
    """

    face: Face
    first: tuple[float, float]
    second: tuple[float, float]
    force: float
    history: History

    @property
    def area(self) -> float:
        """Undeformed area of the patch [m2]."""
        return (self.first[1] - self.first[0]) * (self.second[1] - self.second[0])

    def faces(self, mesh: BrickMesh) -> Int[np.ndarray, "faces 4"]:
        """Element faces of the patch on a mesh; its borders must lie on element borders (else OptionError)."""
        ranges = [(round(a / mesh.edge), round(b / mesh.edge)) for a, b in (self.first, self.second)]
        return mesh.patch(self.face, ranges[0], ranges[1])

    def pressure(self, time: Float[np.ndarray, " times"]) -> Float[np.ndarray, " times"]:
        """Pressure on the patch [Pa] at each time [s]."""
        return self.force / self.area * self.history(time)

    def describe(self) -> dict[str, Any]:
        """The load case as plain values for the meta data of a trajectory (m, N, s)."""
        return {**asdict(self), "face": self.face.value}


def relaxed_young(material: Foam) -> float:
    """Young's modulus of the relaxed material [Pa]."""
    mu = material.shear * (1.0 - material.g1)
    return 9.0 * material.bulk * mu / (3.0 * material.bulk + mu)


def bending_demand(shape: BeamShape, material: Foam, gravity: float, case: LoadCase) -> float:
    """Bending stress at the clamp over what the relaxed material bears before it collapses (DESIGN 3.1).

    ``6 (F a + w L^2 / 2) / (W D^2) / (0.192 E_relaxed)`` with the lever a of the patch, for both axes of bending.
    """
    length, width, depth = shape.length, shape.width, shape.depth
    force = abs(case.force) * max(max(map(abs, case.history.levels)) + case.history.amplitude, 1e-12)
    weight = material.density * gravity * width * depth
    down = weight * length**2 / 2.0
    sideways = axial = 0.0
    lever = 0.5 * (case.first[0] + case.first[1])
    if case.face in (Face.top, Face.bottom):
        down += force * lever
    elif case.face is Face.tip:
        axial = force
        down += force * abs(0.5 * (case.second[0] + case.second[1]) - depth / 2.0)
    else:
        sideways = force * lever
    stress = 6.0 * down / (width * depth**2) + 6.0 * sideways / (depth * width**2) + axial / (width * depth)
    return stress / (0.192 * relaxed_young(material))


def buckling_demand(shape: BeamShape, material: Foam, case: LoadCase) -> float:
    """Largest push on the tip over Euler's load of the relaxed cantilever, pi^2 E I / (4 L^2).

    The solver's pressure follows the tip (Beck's column) and would bear far more, but whoever predicts the beam is
    given nodal forces: under those, a beam beyond Euler's load is not stable and no prediction of it means anything.
    """
    if case.face is not Face.tip:
        return 0.0
    levels = case.force * np.asarray(case.history.levels)
    push = max(float(levels.max()), 0.0) + abs(case.force) * case.history.amplitude
    thin, wide = sorted((shape.width, shape.depth))
    euler = math.pi**2 * relaxed_young(material) * wide * thin**3 / 12.0 / (4.0 * shape.length**2)
    return push / euler


def bending_frequency(shape: BeamShape, material: Foam, sideways: bool = False) -> float:
    """First bending frequency [Hz] of the clamped beam, vertical or sideways, without gravity.

    Euler-Bernoulli with the shear beam in series (Southwell-Dunkerley); the shear modulus is the storage modulus of
    the Prony term at that frequency.
    """
    height = shape.width if sideways else shape.depth
    frequency = 1.0
    for _ in range(20):
        turn = (2.0 * math.pi * frequency * material.tau) ** 2
        mu = material.shear * (1.0 - material.g1 / (1.0 + turn))
        young = 9.0 * material.bulk * mu / (3.0 * material.bulk + mu)
        poisson = young / (2.0 * mu) - 1.0
        bending = (
            1.8751041**2 / (2.0 * math.pi * shape.length**2) * math.sqrt(young * height**2 / 12.0 / material.density)
        )
        kappa = 10.0 * (1.0 + poisson) / (12.0 + 11.0 * poisson)
        shear = math.sqrt(kappa * mu / material.density) / (4.0 * shape.length)
        frequency = 1.0 / math.hypot(1.0 / bending, 1.0 / shear)
    return frequency


@dataclass
class LoadOptions:
    """What loads are drawn.

    force [N]: range, times `force_scale`. patch [m]: range of the patch's sides. pull_fraction: share of loads that
    pull. held_fraction: share of hand loads that hold already at the first frame. ramp [s]: range of the hand's ramps.
    demand_limit: bending demand above which a load is not tried (see `bending_demand`); buckling_limit: the same for
    pushes on the tip (see `buckling_demand`).
    """

    force: list[float] = field(default_factory=lambda: [1.0, 5.0])
    force_scale: float = 1.0
    patch: list[float] = field(default_factory=lambda: [0.05, 0.2])
    pull_fraction: float = 0.25
    held_fraction: float = 0.4
    ramp: list[float] = field(default_factory=lambda: [0.5, 5.0])
    demand_limit: float = 1.5
    buckling_limit: float = 0.5


FACE_SHARES = {Face.top: 0.35, Face.bottom: 0.15, Face.front: 0.15, Face.back: 0.15, Face.tip: 0.2}


def draw_load(
    rng: np.random.Generator,
    shape: BeamShape,
    material: Foam,
    regime: Regime,
    duration: float,
    edge: float,
    options: LoadOptions,
) -> LoadCase:
    """A random load case on element borders of a mesh with elements of `edge` [m]."""
    face = list(FACE_SHARES)[rng.choice(len(FACE_SHARES), p=list(FACE_SHARES.values()))]
    sizes = (shape.length, shape.width, shape.depth)
    ranges = []
    for axis in sorted(FACE_AXES[face][2:]):
        count = round(sizes[axis] / edge)
        low, high = (max(1, round(side / edge)) for side in options.patch)
        side = int(rng.integers(min(low, count), min(high, count) + 1))
        # Along the beam the patch stays away from the clamp, where a load moves nothing.
        start = int(rng.integers(min(round(0.25 * count), count - side) if axis == 0 else 0, count - side + 1))
        ranges.append((start * edge, (start + side) * edge))
    force = (
        options.force_scale
        * rng.uniform(options.force[0], options.force[1])
        * (-1.0 if rng.random() < options.pull_fraction else 1.0)
    )
    if regime is Regime.hand:
        history = _hand_history(rng, duration, options)
    else:
        history = _dynamic_history(rng, bending_frequency(shape, material, face in (Face.front, Face.back)))
    return LoadCase(face, ranges[0], ranges[1], force, history)


def _hand_history(rng: np.random.Generator, duration: float, options: LoadOptions) -> History:
    """Ramps and holds; the first ramp begins early enough to be seen."""
    level = float(rng.uniform(0.4, 1.0)) if rng.random() < options.held_fraction else 0.0
    time = float(rng.uniform(0.0, min(0.3, 0.5 * duration)))
    times, levels = [time], [level]
    while time < duration:
        ramp = float(np.exp(rng.uniform(*np.log(options.ramp))))
        target = float(rng.uniform(0.5, 1.0)) if level < 0.3 else float(rng.choice([0.0, rng.uniform(0.0, 0.5), 1.0]))
        if abs(target - level) < 0.2:
            target = 0.0
        hold = float(rng.uniform(0.05, 0.6))
        times += [time + ramp, time + ramp + hold]
        levels += [target, target]
        time, level = times[-1], target
    return History("ramps", tuple(times), tuple(levels))


def _dynamic_history(rng: np.random.Generator, resonance: float) -> History:
    """Release from a held load, an impulse, or a sine near the first bending frequency [Hz]."""
    kind = str(rng.choice(["release", "impulse", "sine"]))
    start = float(rng.uniform(0.01, 0.04))
    if kind == "release":
        return History(kind, (start, start + float(rng.uniform(0.005, 0.02))), (1.0, 0.0))
    if kind == "impulse":
        width = float(rng.uniform(0.03, 0.1))
        return History(kind, (start, start + 0.5 * width, start + width), (0.0, 1.0, 0.0))
    frequency = resonance * float(rng.uniform(0.7, 1.2))
    return History(kind, (0.0, 1.0), (0.0, 0.0), amplitude=1.0, frequency=frequency, sine_start=start)
