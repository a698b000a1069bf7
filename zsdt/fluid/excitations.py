"""Which motions of a vessel are made: the range that the solver is tested for, and random draws inside it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from zsdt.errors import OptionError
from zsdt.fluid.motion import Excitation, Tilt, VelocityChange
from zsdt.fluid.watch import GENTLE_SPEED, check_range
from zsdt.scene import Liquid


def check_excitation(excitation: Excitation, liquid: Liquid) -> None:
    """Raises OptionError where a change of velocity is outside of what the solver is tested for with the liquid."""
    for change in excitation.changes:
        check_range(liquid, change.size, change.duration)


@dataclass
class MotionOptions:
    """Ranges from which motions are drawn: [lowest, highest] each.

    speed [m/s] before the stop, ramp [s] of the stop. pulse_fraction: share of motions that begin at rest with one or
    two pulses of `pulse` [s] and pauses of `pause` [s] between them; the others move evenly until they stop. at_once:
    share of stops without a ramp, of those slow enough and without pulses (0: hands are not like that).
    tilt_fraction: share with a tilt of up to `tilt` [rad], there and back in `tilt_duration` [s], ending with the stop.
    """

    speed: list[float] = field(default_factory=lambda: [0.3, 0.9])
    ramp: list[float] = field(default_factory=lambda: [0.02, 0.05])
    pulse_fraction: float = 0.3
    pulse: list[float] = field(default_factory=lambda: [0.04, 0.1])
    pause: list[float] = field(default_factory=lambda: [0.0, 0.1])
    at_once: float = 0.0
    tilt_fraction: float = 0.0
    tilt: list[float] = field(default_factory=lambda: [0.05, 0.2])
    tilt_duration: list[float] = field(default_factory=lambda: [0.4, 0.8])

    def __post_init__(self) -> None:
        for name in ("speed", "ramp", "pulse", "pause", "tilt", "tilt_duration"):
            limits = getattr(self, name)
            if len(limits) != 2 or not 0.0 <= limits[0] <= limits[1]:
                raise OptionError(f"The range {list(limits)} of {name} must be [lowest, highest] without signs.")
        if self.speed[0] <= 0 or self.ramp[0] <= 0 or self.pulse[0] <= 0 or self.tilt_duration[0] <= 0:
            raise OptionError("Speed, ramp, pulse and tilt_duration must be positive; use at_once for sudden stops.")
        if not all(0.0 <= share <= 1.0 for share in (self.pulse_fraction, self.at_once, self.tilt_fraction)):
            raise OptionError("pulse_fraction, at_once and tilt_fraction are shares between 0 and 1.")

    def check(self, liquid: Liquid) -> None:
        """Raises OptionError where these ranges reach beyond what the solver is tested for (`watch.check_range`)."""
        check_range(liquid, self.speed[1], min(self.ramp[0], self.pulse[0]) if self.pulse_fraction else self.ramp[0])
        if self.at_once:
            check_range(liquid, self.speed[0], 0.0)


def draw_motion(speed: float, options: MotionOptions, liquid: Liquid, rng: np.random.Generator) -> Excitation:
    """A random motion with a stop from `speed` [m/s] in a random horizontal direction.

    Raises: OptionError where it is outside of what is tested for the liquid.
    """
    ramp, pulsed = _between(options.ramp, rng), rng.random() < options.pulse_fraction
    if rng.random() < options.at_once and speed <= GENTLE_SPEED and not pulsed:
        ramp = 0.0
    final = _horizontal(speed, rng)
    before, now = (0.0, 0.0, 0.0), 0.0
    changes: list[VelocityChange] = []
    if pulsed:
        reached = np.zeros(3)
        for last in [True] if rng.random() < 0.5 else [False, True]:
            aim = final if last else _nearby(final, speed, rng)
            changes.append(VelocityChange(now, _between(options.pulse, rng), _plain(aim - reached)))
            now, reached = changes[-1].end + _between(options.pause, rng), aim
    else:
        before = _plain(final)
    changes.append(VelocityChange(now, ramp, _plain(-final)))
    tilt = None
    if rng.random() < options.tilt_fraction and ramp > 0.0:  # tilt and stop end together
        lasting = _between(options.tilt_duration, rng)
        early = lasting - changes[-1].end
        changes = [replace(c, start=c.start + max(early, 0.0)) for c in changes]
        tilt = Tilt(max(-early, 0.0), lasting, _between(options.tilt, rng), float(rng.uniform(0.0, 2.0 * np.pi)))
    excitation = Excitation(before, tuple(changes), tilt)
    check_excitation(excitation, liquid)
    return excitation


def _between(limits: list[float], rng: np.random.Generator) -> float:
    return float(rng.uniform(limits[0], limits[1]))


def _plain(vector: Float[np.ndarray, "3"]) -> tuple[float, float, float]:
    return (float(vector[0]), float(vector[1]), float(vector[2]))


def _horizontal(speed: float, rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    heading = rng.uniform(0.0, 2.0 * np.pi)
    return speed * np.array([math.cos(heading), math.sin(heading), 0.0])


def _nearby(final: Float[np.ndarray, "3"], speed: float, rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """A horizontal velocity of at most `speed` whose difference to `final` is at most `speed` as well."""
    while True:
        guess = _horizontal(speed * rng.uniform(0.3, 1.0), rng)
        if np.linalg.norm(guess - final) <= speed:
            return guess
