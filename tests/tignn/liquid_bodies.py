"""Small liquids for the tests of the node form: a lattice with disorder in a vessel, and made-up motion."""

import numpy as np

from zsdt.fluid.vessel import Vessel
from zsdt.scene import Liquid, VesselFamily, VesselShape
from zsdt.trajectory import Body, Trajectory

PITCH = 0.006


def make_liquid(radius: float = 0.022, depth: float = 0.03, seed: int = 0, density: float = 1261.0) -> Body:
    """Glycerin in a cylinder; the particles stand a little off a lattice."""
    shape = VesselShape(VesselFamily.cylinder, [0.0, 0.08], [radius, radius])
    axis = np.arange(-radius, radius, PITCH)
    points = np.stack(np.meshgrid(axis, axis, np.arange(PITCH / 2, depth, PITCH), indexing="ij"), axis=-1).reshape(
        -1, 3
    )
    points = points + np.random.default_rng(seed).normal(size=points.shape) * 0.1 * PITCH
    points = points[Vessel(shape).distance(points) > 0.3 * PITCH]
    draw = np.random.default_rng(seed + 1)
    return Body(
        points=points,
        pairs=np.zeros((0, 2), np.int64),
        clamped=np.zeros(len(points), bool),
        mass=draw.uniform(0.8, 1.2, len(points)) * density * PITCH**3,
        frame_dt=0.004,
        pitch=PITCH,
        liquid=Liquid(density=density),
        vessel=shape,
    )


def make_flow(body: Body, frames: int = 8, seed: int = 0, name: str = "made") -> Trajectory:
    """A swirl that dies away and warms the liquid: not physics, but smooth and of the right size."""
    draw = np.random.default_rng(seed)
    turn = draw.normal(size=(3, 3)) * 2.0
    decay = np.exp(-0.15 * np.arange(frames))[:, None, None]
    velocity = decay * ((body.points - body.points.mean(0)) @ (turn - turn.T))[None]
    position = body.points + np.cumsum(velocity * body.frame_dt, axis=0)
    energy = 1e-2 * (1.1 - decay) * np.ones((1, body.nodes, 1))
    return Trajectory(
        body=body,
        times=np.arange(frames) * body.frame_dt,
        fields={"position": position, "velocity": velocity, "internal_energy": energy},
        load=np.zeros((frames, body.nodes, 3)),
        meta={"name": name, "regime": "glycerin"},
    )
