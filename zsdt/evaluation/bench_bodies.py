"""Bodies of any size for the clock: beams as grids of cubes, glycerin as a lattice in a cylinder. Nothing is trained or
judged on them."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from zsdt.fluid.vessel import Vessel
from zsdt.graph import brick_grid
from zsdt.scene import Foam, Liquid, VesselFamily, VesselShape
from zsdt.trajectory import Body, Trajectory

SLENDERNESS = 3.0  # length over width of the beams
FRAMES = 5
STIR = 0.02  # m/s of the first velocities, so that nothing is a special case at rest


def beam_of(nodes: int, pitch: float = 0.05, frame_dt: float = 0.005) -> Trajectory:
    """A clamped foam beam of about `nodes` nodes on a grid of `pitch` [m], hardly moving, for a few frames."""
    side = max(round((nodes / SLENDERNESS) ** (1 / 3)) - 1, 1)
    grid = brick_grid((max(round(nodes / (side + 1) ** 2) - 1, 1), side, side), pitch)
    count, foam = len(grid.points), Foam()
    share = np.bincount(grid.cells.ravel(), minlength=count) / 8.0
    body = Body(
        points=grid.points,
        pairs=grid.pairs,
        clamped=grid.points[:, 0] < 1e-9,
        mass=foam.density * pitch**3 * share,
        frame_dt=frame_dt,
        pitch=pitch,
        cells=grid.cells,
        material=foam,
    )
    velocity = STIR * np.random.default_rng(0).normal(size=(count, 3)) * ~body.clamped[:, None]
    zeros = {"stress": 6, "elastic_energy": 1, "dissipated_energy": 1}
    fields = {"position": grid.points, "velocity": velocity} | {n: np.zeros((count, c)) for n, c in zeros.items()}
    return _held(body, fields)


def finer_beam(nodes: int) -> Trajectory:
    """The same beam of 0.6 x 0.2 x 0.2 m for every count of nodes: the more of them, the finer its grid."""
    side = max(round((nodes / SLENDERNESS) ** (1 / 3)) - 1, 1)
    return beam_of(nodes, pitch=0.2 / side)


def finer_glass(particles: int) -> Trajectory:
    """The same 0.2 litres of glycerin for every count of particles: the more of them, the smaller."""
    return glass_of(particles, spacing=(2e-4 / particles) ** (1 / 3))


def glass_of(particles: int, spacing: float = 0.006, frame_dt: float = 0.004) -> Trajectory:
    """About `particles` particles of glycerin on a lattice of `spacing` [m] in a cylinder as high as wide."""
    aim = float(particles)
    for _ in range(4):  # what a round wall cuts off a lattice is made up for
        shape, points = _lattice(aim, spacing)
        aim *= particles / len(points)
    draw = np.random.default_rng(0)
    points = points + 0.05 * spacing * draw.normal(size=points.shape)
    liquid = Liquid()
    body = Body(
        points=points,
        pairs=np.zeros((0, 2), np.int64),
        clamped=np.zeros(len(points), bool),
        mass=np.full(len(points), liquid.density * spacing**3),
        frame_dt=frame_dt,
        pitch=spacing,
        liquid=liquid,
        vessel=shape,
    )
    velocity = STIR * draw.normal(size=points.shape)
    return _held(body, {"position": points, "velocity": velocity, "internal_energy": np.zeros((len(points), 1))})


def _lattice(aim: float, spacing: float) -> tuple[VesselShape, Float[np.ndarray, "points 3"]]:
    """A cylinder for the volume of `aim` particles, and the lattice points in it."""
    radius = (aim / (2.0 * math.pi)) ** (1 / 3) * spacing
    depth = aim / (math.pi * radius**2) * spacing**3
    shape = VesselShape(VesselFamily.cylinder, [0.0, 1.6 * depth], [radius, radius])
    axis = np.arange(0.5 * spacing - math.ceil(radius / spacing) * spacing, radius, spacing)
    height = spacing * (0.5 + np.arange(round(depth / spacing)))
    points = np.stack(np.meshgrid(axis, axis, height, indexing="ij"), axis=-1).reshape(-1, 3)
    return shape, points[Vessel(shape).distance(points) > 0.3 * spacing]


def _held(body: Body, fields: dict[str, np.ndarray]) -> Trajectory:
    """The same fields in every frame: only the first is ever read by a clock."""
    frames = {name: np.repeat(values[None], FRAMES, axis=0) for name, values in fields.items()}
    load = np.zeros((FRAMES, body.nodes, 3))
    return Trajectory(body, body.frame_dt * np.arange(FRAMES), frames, load, meta={"name": f"{body.nodes}_nodes"})
