"""How the cost of a frame grows with the size of a body: milliseconds and memory from 100 to 100,000 nodes.

A larger body at the same pitch shows the cost of the graph. A finer graph of the same body is another question, and is
measured apart: explicit sub-steps get shorter with the pitch, so their number per frame grows as nodes^(1/3).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from zsdt.errors import OptionError
from zsdt.evaluation.bench import Case, Progress, measure
from zsdt.fluid.solver import SphOptions, SphSolver
from zsdt.fluid.vessel import Vessel
from zsdt.fluid.wall_tables import WallTables
from zsdt.tignn.engine import Engine, NodeField
from zsdt.tignn.particle_engine import ParticleEngine, ParticleState
from zsdt.tignn.particle_kernel import ACCOUNT, stored
from zsdt.tignn.particle_options import ParticleOptions
from zsdt.tignn.particle_profiles import ParticleProfiles
from zsdt.trajectory import Body, Trajectory

SIZES = (100, 300, 1000, 3000, 10000, 30000, 100000)
FRAME_SECONDS = 3.0  # a method whose next size would take longer per frame stops there, and the table says so


@dataclass(frozen=True)
class Grower:
    """A method whose cost is followed: `make` gives its engine, `body` a trajectory of about so many nodes."""

    scene: str
    method: str
    make: Callable[[], Engine]
    body: Callable[[int], Trajectory]


def grow(
    growers: Sequence[Grower], sizes: Sequence[int] = SIZES, rounds: int = 2, progress: Progress | None = None
) -> list[dict[str, Any]]:
    """One row per method and size: scene, method, nodes, ms_p50, peak_mb. All methods of a size take turns.

    A method leaves where its next size would take more than `FRAME_SECONDS` per frame.
    """
    rows: list[dict[str, Any]] = []
    bodies: dict[tuple[Any, int], Trajectory] = {}
    staying = list(growers)
    for place, size in enumerate(sizes):
        cases = []
        for grower in staying:
            key = (grower.body, size)
            if key not in bodies:
                bodies[key] = grower.body(size)
            cases.append(Case(grower.make, bodies[key], {"scene": grower.scene, "method": grower.method}))
        found = measure(cases, rounds, 3, warm=place == 0)
        rows += [{name: row[name] for name in ("scene", "method", "nodes", "ms_p50", "peak_mb")} for row in found]
        bodies.clear()
        if progress is not None:
            progress(f"{size} nodes")
        if place + 1 < len(sizes):
            factor = sizes[place + 1] / size
            pace = {(row["scene"], row["method"]): row["ms_p50"] for row in found}
            staying = [g for g in staying if factor * pace.get((g.scene, g.method), math.inf) < 1e3 * FRAME_SECONDS]
    return rows


@dataclass(frozen=True)
class Growth:
    """`ms = at_1000 (nodes / 1000)^exponent`: the fitted law, the largest factor by which a point is off it, the sizes
    it was fitted on."""

    exponent: float
    at_1000: float
    worst_factor: float
    smallest: int
    largest: int


def fit_growth(
    nodes: Float[np.ndarray, " sizes"], milliseconds: Float[np.ndarray, " sizes"], least: int = 1000
) -> Growth:
    """Least squares in logarithms over the sizes from `least` nodes on: below, a frame costs what calls cost.

    Fewer than two such sizes give NaN.
    """
    used = (nodes >= 0.8 * least) & np.isfinite(milliseconds) & (milliseconds > 0)
    if used.sum() < 2:
        return Growth(math.nan, math.nan, math.nan, 0, 0)
    x, y = np.log(nodes[used] / 1000.0), np.log(milliseconds[used])
    exponent, level = np.polyfit(x, y, 1)
    off = np.abs(y - (exponent * x + level)).max()
    return Growth(float(exponent), float(np.exp(level)), float(np.exp(off)), *(int(f(nodes[used])) for f in (min, max)))


def exponents(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row per scene and method: the fitted law of what `grow` found."""
    keys = dict.fromkeys((row["scene"], row["method"]) for row in rows)
    found = []
    for scene, method in keys:
        mine = [row for row in rows if (row["scene"], row["method"]) == (scene, method)]
        nodes, milliseconds = (np.array([row[name] for row in mine], float) for name in ("nodes", "ms_p50"))
        law = fit_growth(nodes, milliseconds)
        found.append(
            {
                "scene": scene,
                "method": method,
                "exponent": law.exponent,
                "ms_at_1000_nodes": law.at_1000,
                "worst_factor": law.worst_factor,
                "from_nodes": law.smallest,
                "to_nodes": law.largest,
            }
        )
    return found


class LooseParticles(ParticleEngine):
    """The particle engine without the search for the first pressure, which costs as much as many frames."""

    def __init__(self, profiles: ParticleProfiles, options: ParticleOptions, single: bool):
        super().__init__(profiles, options)
        self.single = single

    def start(self, fields: dict[str, NodeField], load: Float[np.ndarray, "nodes 3"]) -> ParticleState:
        """The given particles at zero pressure."""
        x, v = (np.ascontiguousarray(fields[name], float).copy() for name in ("position", "velocity"))
        self.scratch.since[:] = np.inf
        n = len(x)
        held = stored(self.constants, self.walls, x)
        return ParticleState(x, v, np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(len(ACCOUNT)), held)


class OwnSph:
    """The liquid's solver on the given particles themselves, nothing carried along."""

    name = "sph"

    def prepare(self, body: Body) -> None:
        """Wall tables and the solver. Raises: OptionError where the body is no liquid in a vessel."""
        liquid = body.liquid
        if liquid is None or body.vessel is None:
            raise OptionError("The liquid's solver needs a liquid in a known vessel.")
        given = SphOptions()
        options = replace(given, watch=replace(given.watch, layers=1.0, residual=1e9, nearest=0.0))
        vessel = Vessel(body.vessel)
        tables = WallTables(vessel, options.smoothing * body.pitch, options.fineness)
        self._make = lambda: SphSolver(vessel, liquid, body.points.copy(), body.pitch, options, tables=tables)
        self._dt = body.frame_dt

    def start(self, fields: dict[str, NodeField], load: Float[np.ndarray, "nodes 3"]) -> SphSolver:
        """A solver that begins with the given velocities."""
        solver = self._make()
        solver.start(np.array(fields["velocity"], float))
        return solver

    def step(self, state: SphSolver, load: Any, load_next: Any) -> SphSolver:
        """One frame."""
        state.advance(self._dt)
        return state

    def read(self, state: SphSolver) -> dict[str, NodeField]:
        """Fields of the particles."""
        frame = state.frame()
        return {name: getattr(frame, name) for name in ("position", "velocity", "internal_energy")}

    def account(self, state: SphSolver) -> dict[str, float]:
        """None is read by a clock."""
        return {}
