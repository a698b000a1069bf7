"""Bodies, constants and networks that the tests of the sub-step form share."""

import numpy as np
import torch

from zsdt.graph import brick_grid
from zsdt.scene import Foam
from zsdt.tignn.cell_energy import EnergyCorrection, nominal_constants
from zsdt.trajectory import Body

PITCH = 0.05


def body_of(counts=(3, 2, 2), frame_dt=1 / 60, material=None):
    grid = brick_grid(counts, PITCH)
    mass = np.zeros(len(grid.points))
    np.add.at(mass, grid.cells.ravel(), 18.44 * PITCH**3 / 8)
    return Body(
        points=grid.points,
        pairs=grid.pairs,
        clamped=grid.points[:, 0] < 1e-9,
        mass=mass,
        frame_dt=frame_dt,
        pitch=PITCH,
        cells=grid.cells,
        material=Foam() if material is None else material,
    )


def foam_constants():
    foam = Foam()
    constants = nominal_constants(foam.bulk, foam.shear, foam.g1, foam.tau)
    rng = np.random.default_rng(3)
    constants.theta[4:14] += 0.2 * rng.standard_normal(10)
    constants.theta[14] = -0.2
    constants.boundary = 0.1 * rng.standard_normal(constants.boundary.shape)
    return constants


def random_correction(seed=0):
    generator = torch.Generator().manual_seed(seed)
    correction = EnergyCorrection(7, 0.5, generator)
    with torch.no_grad():
        correction.outer.normal_(generator=generator)
        correction.outer_bias.normal_(generator=generator)
    return correction
