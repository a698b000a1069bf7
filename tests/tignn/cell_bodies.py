"""Bodies, constants and networks that the tests of the sub-step form share."""

import numpy as np
import torch

from zsdt.graph import brick_grid
from zsdt.scene import Foam
from zsdt.tignn.cell_energy import CellOptions, EnergyCorrection, card_of, nominal_constants
from zsdt.tignn.cell_engine import CellEngine
from zsdt.trajectory import Body, DatasetEntry, Trajectory, write_index, write_trajectory

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


def write_cell_beams(folder, cases, count):
    """Data set of `count` frames whose truth is the cell engine with the material's own constants.

    cases: (split, counts, regime, peak tip force in N; negative: a push that no model can follow).
    """
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    for k, (split, counts, regime, peak) in enumerate(cases):
        body = body_of(counts, frame_dt=0.005 if regime == "dynamic" else 1 / 60)
        engine = CellEngine(nominal_constants(*card_of(body)), CellOptions())
        engine.prepare(body)
        zero = np.zeros_like(body.points)
        load = np.zeros((count, body.nodes, 3))
        tip = body.points[:, 0] > body.points[:, 0].max() - 1e-9
        way = [1.0, 0.0, 0.0] if peak < 0 else [0.0, 0.4, -1.0]
        load[:, tip] = np.sin(np.linspace(0, 3, count))[:, None, None] * np.array(way) * peak / tip.sum()
        state = engine.start({"position": body.points, "velocity": zero}, zero)
        state.offset[:] = 0.0
        frames = [engine.read(state)]
        for frame in range(1, count):
            state = engine.step(state, load[frame - 1], load[frame])
            frames.append(engine.read(state))
        fields = {name: np.stack([f[name] for f in frames]) for name in frames[0]}
        if peak < 0:  # a beam whose truth no model with these loads can follow: pushed far beyond buckling
            fields["position"] = np.repeat(fields["position"][:1], count, axis=0)
            fields["position"][1:, tip, 2] += 1e-4
        name = f"beam_{k}"
        times = np.arange(count) * body.frame_dt
        write_trajectory(folder / f"{name}.h5", Trajectory(body, times, fields, load, meta={"name": name}))
        entries.append(DatasetEntry(f"{name}.h5", name, split, regime, "cells"))
    write_index(folder, entries)
    return folder
