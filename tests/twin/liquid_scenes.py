"""Liquids for tests of the glass twin: a reality of more particles and another viscosity than the twin is told."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from zsdt.fluid.motion import Excitation, VelocityChange
from zsdt.fluid.sampling import fill
from zsdt.fluid.vessel import Vessel
from zsdt.scene import Liquid, VesselFamily, VesselShape
from zsdt.tignn.particle_engine import ParticleEngine
from zsdt.tignn.particle_options import ParticleOptions
from zsdt.trajectory import Body
from zsdt.twin.glass_levels import surface_heights

FPS, LEVEL, RADIUS = 60.0, 0.045, 0.03
SHAPE = VesselShape(VesselFamily.cylinder, [0.0, 0.1], [RADIUS, RADIUS])
RAMP, SPEED = 0.05, 0.3
TOLD, TRUE = 0.35, 0.42  # Pa s: thinner than glycerin, so that it swings more than once
FRAMES = 24
NUDGE, AGAIN = 10, 0.15  # frame after t0 at which a glass is moved again, and how fast [m/s]


@dataclass
class SeenSurface:
    """A profile as the loop gives it."""

    places: np.ndarray
    height: np.ndarray
    seen: np.ndarray


def engine():
    return ParticleEngine(options=ParticleOptions(sound_speed=5.0))


@cache
def liquid(particles, viscosity=TOLD, seed=0):
    """A body at rest in a cylinder, packed; its motion is the stop."""
    filled = fill(Vessel(SHAPE), LEVEL, particles, np.random.default_rng(seed))
    count = len(filled.points)
    return Body(
        filled.points, np.zeros((0, 2), np.int64), np.zeros(count, bool),
        np.full(count, 1261.0 * filled.spacing**3), 1 / FPS, filled.spacing,
        liquid=Liquid(viscosity=viscosity), vessel=SHAPE, motion=stop().history(),
    )  # fmt: skip


def stop():
    return Excitation((SPEED, 0.0, 0.0), (VelocityChange(0.0, RAMP, (-SPEED, 0.0, 0.0)),))


def advance(own, state, acceleration):
    load = -own.body.mass[:, None] * np.asarray(acceleration)
    return own.step(state, load, load)


@dataclass
class Reality:
    """From t0 on; `before`: heights while the vessel is stopped, in the frames of the ramp."""

    body: Body
    position: np.ndarray
    velocity: np.ndarray
    places: np.ndarray
    height: np.ndarray
    before: np.ndarray

    def profile(self, frame, noise=2e-4, seed=0):
        rng = np.random.default_rng([seed, frame])
        wrong = noise * rng.standard_normal(len(self.places))
        return SeenSurface(self.places, self.height[frame] + wrong, np.ones(len(self.places), bool))


def nudge(frame):
    """Acceleration [m/s2] of the vessel over the frame that follows t0 + `frame` of a glass that is moved again: it
    sets off within two frames, goes on for four and stops within two."""
    since = frame - NUDGE
    return np.array([AGAIN * FPS / 2 * ((0 <= since < 2) - float(6 <= since < 8)), 0.0, 0.0])


@cache
def reality(particles=420, viscosity=TRUE, frames=FRAMES, again=False):
    """What really happens: a stop within three frames, and the liquid from then on; again: moved once more."""
    body = liquid(particles, viscosity, seed=3)
    own = engine()
    own.prepare(body)
    state = own.start({"position": body.points, "velocity": np.zeros_like(body.points)}, np.zeros_like(body.points))
    stopping, states = [state], []
    for k in range(round(RAMP * FPS)):
        state = advance(own, state, stop().acceleration((k + 0.5) / FPS))
        stopping.append(state)
    states.append(stopping.pop())
    for k in range(frames - 1):
        states.append(advance(own, states[-1], nudge(k) if again else np.zeros(3)))
    x = np.linspace(-0.9, 0.9, 20) * RADIUS
    places = np.stack([x, np.sqrt(RADIUS**2 - x**2)], axis=1)
    height, before = (
        np.stack([surface_heights(body, s.position, places) for s in some]) for some in (states, stopping)
    )
    position, velocity = (np.stack([getattr(s, name) for s in states]) for name in ("position", "velocity"))
    return Reality(body, position, velocity, places, height, before)
