"""Bodies at rest to learn a first stress from: first frames of a data set, and more that the solver computes."""

from __future__ import annotations

import logging
import pickle
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from zsdt.errors import RunRejected
from zsdt.files import atomic_path
from zsdt.scene import BeamShape
from zsdt.solid.loads import LoadOptions, Regime, bending_demand, draw_load
from zsdt.solid.mesh import CoarseView, mesh_of
from zsdt.solid.solver import BrickSolver, Load
from zsdt.trajectory import Body, Dataset

log = logging.getLogger(__name__)

REFINEMENT = 2  # elements per graph pitch, as in the data sets


@dataclass(frozen=True)
class Rest:
    """A body at rest: position [nodes, 3] m, Cauchy stress [nodes, 6] Pa."""

    body: Body
    position: Float[np.ndarray, "nodes 3"]
    stress: Float[np.ndarray, "nodes 6"]


def first_frames(data: Dataset, split: str) -> list[Rest]:
    """First frames of the trajectories of a split."""
    found = []
    for entry in data.split(split):
        trajectory = data.read(entry)
        found.append(Rest(trajectory.body, trajectory.fields["position"][0], trajectory.fields["stress"][0]))
    return found


def turned(rest: Rest, which: int) -> Rest:
    """One of the eight symmetric images of a cross-section (mirrors and quarter turns); 0 is the body itself."""
    matrix = np.eye(3)
    if which & 4:
        matrix = matrix[[0, 2, 1]]
    matrix = np.diag([1.0, -1.0 if which & 1 else 1.0, -1.0 if which & 2 else 1.0]) @ matrix
    i, j = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])
    tensor = np.empty((len(rest.stress), 3, 3))
    tensor[:, i, j] = tensor[:, j, i] = rest.stress
    body = replace(rest.body, points=rest.body.points @ matrix.T, gravity=matrix @ rest.body.gravity)
    return Rest(body, rest.position @ matrix.T, (matrix @ tensor @ matrix.T)[:, i, j])


def sample_equilibria(bodies: list[Body], count: int, seed: int, scratch: Path) -> list[Rest]:
    """`count` equilibria of beams with the sizes of `bodies` (brick beams with a material; others are passed over).

    Stiffness and gravity are drawn around those of the body, and half of the beams hold a load. The result is kept in
    `scratch` and read from there the next time.
    """
    usable = [b for b in bodies if b.material is not None and len(b.cells)]
    if not count or not usable:
        return []
    mark = scratch / f"equilibria_{seed}_{count}_{len(bodies)}.pickle"
    if mark.is_file():
        return list(pickle.loads(mark.read_bytes()))
    rng = np.random.default_rng([seed, 0xE9])
    found: list[Rest] = []
    for _ in range(10 * count):
        try:
            found.append(_equilibrium(usable[rng.integers(len(usable))], rng))
        except RunRejected:
            continue
        if len(found) % 50 == 0 or len(found) == count:
            log.info("psi_ini: %d of %d extra equilibria", len(found), count)
        if len(found) == count:
            break
    with atomic_path(mark) as beside:
        beside.write_bytes(pickle.dumps(found))
    return found


def _equilibrium(like: Body, rng: np.random.Generator) -> Rest:
    """One beam of the size of `like`. Raises: RunRejected where it collapses."""
    assert like.material is not None
    material = replace(like.material, young=like.material.young * float(np.exp(rng.uniform(-0.4, 0.4))))
    gravity = like.gravity * float(rng.uniform(0.4, 1.5))
    shape = BeamShape(*(float(x) for x in np.ptp(like.points, axis=0)))
    fine, coarse = mesh_of(shape, like.pitch / REFINEMENT), mesh_of(shape, like.pitch)
    case = draw_load(rng, shape, material, Regime.hand, 1.0, fine.edge, LoadOptions(pull_fraction=0.5))
    held = float(rng.uniform(0.1, 1.0)) if rng.random() < 0.5 else 0.0
    if bending_demand(shape, material, float(np.linalg.norm(gravity)), replace(case, force=held * case.force)) > 0.8:
        raise RunRejected("demand", "This load would bend the beam too far.")
    solver = BrickSolver(fine, material, gravity=gravity)
    solver.relax(Load(faces=case.faces(fine)), held * case.force / case.area)
    frame, view = solver.frame(), CoarseView(fine, coarse)
    body = replace(like, material=material, gravity=gravity)
    return Rest(body, frame.position[view.picked], frame.stress[view.picked])
