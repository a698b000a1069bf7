"""How a hand moves a vessel: smooth changes of velocity that end in a stop, and a tilt there and back.

Time runs from 0, the begin of the excitation, to `duration`, its end: t0 of a trajectory. Before 0 the vessel moves
evenly with the liquid at rest in it, so nothing needs to be simulated there (DESIGN 3.2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from zsdt.trajectory import VesselMotion

EDGE = 0.25  # share of a change of velocity in which the acceleration rises, and again in which it falls
SAMPLE = 1e-3  # s between samples of the stored history

Vector = Float[np.ndarray, "3"]


def _bump(s: float) -> float:
    """Acceleration over 0 <= s <= 1 with integral one: flat with two half-cosine edges (a Tukey window)."""
    s = min(s, 1.0 - s)
    if s <= 0.0:
        return 0.0
    return (1.0 if s >= EDGE else 0.5 * (1.0 - math.cos(math.pi * s / EDGE))) / (1.0 - EDGE)


def _bump_integral(s: float) -> float:
    """Integral of `_bump` from 0 to s: from 0 to 1."""
    if s <= 0.0 or s >= 1.0:
        return float(s >= 1.0)
    if s > 0.5:
        return 1.0 - _bump_integral(1.0 - s)
    edge = min(s, EDGE)
    risen = 0.5 * (edge - EDGE / math.pi * math.sin(math.pi * edge / EDGE))
    return (risen + max(s - EDGE, 0.0)) / (1.0 - EDGE)


@dataclass(frozen=True)
class VelocityChange:
    """The vessel's velocity changes by `change` [m/s, 3] in `duration` [s] from `start` [s] on; 0 s is at once."""

    start: float
    duration: float
    change: tuple[float, float, float]

    @property
    def end(self) -> float:
        """Time at which the new velocity is reached [s]."""
        return self.start + self.duration

    @property
    def size(self) -> float:
        """Size of the change [m/s]."""
        return math.sqrt(sum(c * c for c in self.change))


@dataclass(frozen=True)
class Tilt:
    """The vessel leans by up to `angle` [rad] and comes back in `duration` [s], about its floor's centre.

    `heading` [rad] is the horizontal direction towards which the rim leans, from x to y.
    """

    start: float
    duration: float
    angle: float
    heading: float

    def at(self, time: float) -> tuple[float, float, float]:
        """Angle [rad], its rate [rad/s] and its second derivative [rad/s2], of the bump sin^4."""
        s = (time - self.start) / self.duration
        if not 0.0 < s < 1.0:
            return 0.0, 0.0, 0.0
        w = math.pi / self.duration
        sin, cos = math.sin(math.pi * s), math.cos(math.pi * s)
        return (
            self.angle * sin**4,
            self.angle * w * 4.0 * sin**3 * cos,
            self.angle * w * w * (12.0 * sin**2 * cos**2 - 4.0 * sin**4),
        )


@dataclass(frozen=True)
class Excitation:
    """Motion of a vessel that ends at rest: velocity before time 0, changes of velocity, and perhaps a tilt.

    Vectors are in the axes of the vessel, whose origin is the centre of its floor, except `velocity`, which is in those
    of the room. Its velocity after the last change is zero to rounding.
    """

    before: tuple[float, float, float]
    changes: tuple[VelocityChange, ...]
    tilt: Tilt | None = None
    g: float = 9.81

    @property
    def duration(self) -> float:
        """Time of the first frame [s]: nothing moves the vessel from there on."""
        return max([c.end for c in self.changes] + ([self.tilt.start + self.tilt.duration] if self.tilt else []))

    @property
    def jump(self) -> Vector:
        """Velocity [m/s] that the liquid has relative to the vessel because the vessel stops at once at the end."""
        sudden = [c.change for c in self.changes if c.duration == 0.0]
        return -np.sum(sudden, axis=0) if sudden else np.zeros(3)

    def velocity(self, time: float) -> Vector:
        """Velocity of the vessel in the room [m/s]."""
        total = np.array(self.before)
        for c in self.changes:
            s = (time - c.start) / c.duration if c.duration > 0 else float(time >= c.start)
            total += _bump_integral(s) * np.array(c.change)
        return total

    def acceleration(self, time: float) -> Vector:
        """Acceleration of the vessel [m/s2]; changes at once are not in it (see `jump`)."""
        total = np.zeros(3)
        for c in self.changes:
            if c.duration > 0:
                total += _bump((time - c.start) / c.duration) / c.duration * np.array(c.change)
        return total if self.tilt is None else self.rotation(time).T @ total

    def gravity(self, time: float) -> Vector:
        """Gravity [m/s2]."""
        down = np.array([0.0, 0.0, -self.g])
        return down if self.tilt is None else self.rotation(time).T @ down

    def _axis(self) -> Vector:
        """Axis of the tilt: horizontal, so that a positive angle leans the rim towards the heading."""
        if self.tilt is None:
            return np.zeros(3)
        return np.array([-math.sin(self.tilt.heading), math.cos(self.tilt.heading), 0.0])

    def rotation(self, time: float) -> Float[np.ndarray, "3 3"]:
        """Matrix whose columns are the axes of the vessel in the room."""
        angle = self.tilt.at(time)[0] if self.tilt else 0.0
        x, y, z = self._axis()
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross

    def angular_velocity(self, time: float) -> Vector:
        """Rotation of the vessel [rad/s]; its axis is the same in the room and in the vessel."""
        return self.tilt.at(time)[1] * self._axis() if self.tilt else np.zeros(3)

    def angular_acceleration(self, time: float) -> Vector:
        """Rate of the rotation [rad/s2]."""
        return self.tilt.at(time)[2] * self._axis() if self.tilt else np.zeros(3)

    def history(self, lead: float = 0.1) -> VesselMotion:
        """What a camera on the room sees of the vessel: samples of 1 ms from `lead` [s] before the excitation to t0."""
        count = math.ceil((self.duration + lead) / SAMPLE - 1e-9)
        before = SAMPLE * np.arange(-count, 1)
        times = before + self.duration
        return VesselMotion(
            times=before,
            velocity=np.stack([self.velocity(t) for t in times]),
            gravity=np.stack([self.gravity(t) for t in times]),
        )

    def describe(self) -> dict[str, Any]:
        """What is said of it in meta data: kind, speed of the stop [m/s], direction [rad], ramp [s], pulses, tilt."""
        stop = self.changes[-1]
        card: dict[str, Any] = {
            "kind": "stop" if len(self.changes) == 1 else "pulses",
            "speed": stop.size,
            "direction": math.atan2(-stop.change[1], -stop.change[0]),
            "ramp": stop.duration,
            "pulses": [vars(c) for c in self.changes[:-1]],
        }
        return card | ({"tilt": vars(self.tilt)} if self.tilt else {})
