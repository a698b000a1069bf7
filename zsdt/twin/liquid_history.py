"""The liquid at t0 from what happened before: level at first, then carried along as its vessel was seen to move.

Psi_ini infers the velocity at t0 from the surface of one picture and the vessel's motion. Where the liquid was seen
level before, it can also be carried there: particles at rest under that level are run through the tracked motion by
the engine itself. They arrive packed as the engine packs them, and with all that one surface does not show.

On the way the liquid is as stiff as it is. The engine's own, slower sound is enough for a liquid that sloshes, but a
hard stop presses that one together by some percent, and it arrives bouncing up and down as no liquid does.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from jaxtyping import Float

from zsdt.fluid.sampling import fill
from zsdt.fluid.vessel import Vessel
from zsdt.scene import Liquid, VesselShape
from zsdt.tignn.engine import Engine, NodeField
from zsdt.tignn.particle_engine import ParticleEngine
from zsdt.trajectory import Body, VesselMotion
from zsdt.twin.glass_graph import GlassGraphOptions

LONGEST_STEP = 1.0 / 240.0  # s: a stop is over within two or three pictures, so its push is given in finer frames
SETTLE = 0.25  # s at rest, in which the packed particles find the engine's own equilibrium
FINENESS = 3.0  # of the wall tables for packing


class FirstState(Enum):
    """Where the liquid at t0 comes from. history: carried there from its rest by the engine; psi_ini where it was never
    seen level. psi_ini: its places from the surface at t0, its velocity inferred from that and the vessel's motion, as
    in the seed."""

    psi_ini = "psi_ini"
    history = "history"


@dataclass(frozen=True)
class CarriedLiquid:
    """The liquid at t0: its body (`body.points` are the positions at t0) and fields name -> [nodes, components]."""

    body: Body
    fields: dict[str, NodeField]


def carried_liquid(
    engine: Engine,
    shape: VesselShape,
    volume: float,
    motion: VesselMotion,
    *,
    liquid: Liquid,
    fps: float,
    gravity: float,
    options: GlassGraphOptions,
) -> CarriedLiquid:
    """A `volume` [m3] of liquid that was at rest when `motion` began, at its end.

    fps: frames per second of the body; gravity [m/s2] downwards.
    Raises: RunRejected where the particles find no place, or the engine leaves its range on the way.
    """
    vessel = Vessel(shape)
    rng = np.random.default_rng([options.seed, 0x61A5])
    filling = fill(vessel, vessel.level(volume), options.particles, rng, fineness=FINENESS)
    count = len(filling.points)
    substeps = max(1, math.ceil(1.0 / fps / LONGEST_STEP - 1e-9))
    body = Body(
        points=filling.points,
        pairs=np.zeros((0, 2), np.int64),
        clamped=np.zeros(count, bool),
        mass=np.full(count, liquid.density * filling.spacing**3),
        frame_dt=1.0 / fps / substeps,
        pitch=filling.spacing,
        gravity=np.array([0.0, 0.0, -gravity]),
        liquid=liquid,
        vessel=shape,
        motion=motion,
    )
    fields = _carried(copy.copy(engine), body)
    return CarriedLiquid(replace(body, points=fields["position"], frame_dt=1.0 / fps), fields)


def _carried(engine: Engine, body: Body) -> dict[str, NodeField]:
    """Settles the body at rest and runs it through its vessel's motion."""
    if isinstance(engine, ParticleEngine) and body.liquid is not None:
        engine.options = replace(engine.options, sound_speed=body.liquid.sound_speed, substeps=0)
    engine.prepare(body)
    nothing = np.zeros_like(body.points)
    state = engine.start({"position": body.points, "velocity": nothing}, nothing)
    for _ in range(round(SETTLE / body.frame_dt)):
        state = engine.step(state, nothing, nothing)
    # Again from rest: what settling turned into heat was never the liquid's.
    state = engine.start({"position": engine.read(state)["position"], "velocity": nothing}, nothing)
    for push in pushes(body):
        load = body.mass[:, None] * push
        state = engine.step(state, load, load)
    return {name: np.asarray(engine.read(state)[name]) for name in ("position", "velocity", "internal_energy")}


def pushes(body: Body) -> Float[np.ndarray, "frames 3"]:
    """Mean acceleration [m/s2] that the liquid feels in each frame until t0 because its vessel changes its velocity."""
    assert body.motion is not None
    motion, dt = body.motion, body.frame_dt
    frames = math.ceil(-motion.times[0] / dt - 1e-9)
    ends = dt * np.arange(-frames, 1)
    velocity = np.stack([np.interp(ends, motion.times, motion.velocity[:, k]) for k in range(3)], axis=1)
    return -np.diff(velocity, axis=0) / dt
