"""Liquids whose motion is known: a lattice of particles in a vessel under a plane surface that swings."""

import numpy as np

from zsdt.fluid.vessel import Vessel
from zsdt.scene import Liquid, VesselFamily, VesselShape
from zsdt.trajectory import Body, Trajectory

PITCH = 0.005
CYLINDER = VesselShape(VesselFamily.cylinder, [0.0, 0.12], [0.035, 0.035])
BOWL = VesselShape(VesselFamily.bowl, [0.0, 0.02, 0.05, 0.1], [0.015, 0.028, 0.038, 0.035])
JAR = VesselShape(VesselFamily.jar, [0.0, 0.12], [0.035, 0.035], aspect=0.8, exponent=5.0)
DT, FRAMES = 0.004, 120
FREQUENCY, DAMPING = 2.9, 0.45


def filled(shape, level=0.05, slope=(0.0, 0.0), pitch=PITCH, seed=0):
    """Places [n, 3] of particles on a jittered lattice inside a vessel and below the plane level + slope . (x, y)."""
    half = max(shape.radii) + pitch
    axis = np.arange(-half, half, pitch)
    grid = np.stack(np.meshgrid(axis, axis, np.arange(0.5 * pitch, shape.rim, pitch), indexing="ij"), -1).reshape(-1, 3)
    grid = grid + 0.1 * pitch * np.random.default_rng(seed).normal(size=grid.shape)
    below = grid[:, 2] + 0.0 * pitch < level + grid[:, :2] @ np.asarray(slope)
    return grid[below & (Vessel(shape).distance(grid) > 0.25 * pitch)]


def body_of(points, shape=CYLINDER):
    """A body of glycerin with these particles."""
    count = len(points)
    return Body(
        points=points,
        pairs=np.zeros((0, 2), np.int64),
        clamped=np.zeros(count, bool),
        mass=np.full(count, 1261.0 * PITCH**3),
        frame_dt=DT,
        pitch=PITCH,
        liquid=Liquid(),
        vessel=shape,
    )


def swing(times, frequency=FREQUENCY, damping=DAMPING):
    """A damped sine of size one that begins at 0.3 and rises."""
    pulsation = 2.0 * np.pi * frequency
    decay = damping / np.sqrt(1.0 - damping**2) * pulsation
    return np.exp(-decay * times) * (0.3 * np.cos(pulsation * times) + np.sin(pulsation * times))


def sloshing(name="any", regime="glycerin", shape=CYLINDER, frames=FRAMES, seed=0):
    """Particles that shear along x in proportion to their height, with a damped sine; heat grows as they slow down."""
    points = filled(shape, level=0.04, pitch=PITCH, seed=seed)
    times = DT * np.arange(frames)
    lean = 0.15 * swing(times)[:, None] * points[:, 2]
    lean = lean - lean[0]
    position = np.repeat(points[None], frames, axis=0)
    position[..., 0] = 0.8 * points[:, 0] + lean + 0.045 * points[:, 2]
    velocity = np.gradient(position, DT, axis=0)
    heat = 0.02 + 0.03 * (1.0 - np.exp(-8.0 * times))[:, None, None] * np.ones((1, len(points), 1))
    fields = {"position": position, "velocity": velocity, "internal_energy": heat}
    load = np.zeros((frames, len(points), 3))
    body = body_of(position[0], shape)
    return Trajectory(body, times, fields, load, meta={"name": name, "regime": regime})
