"""What the clock times: trained engines on every backend, untrained widths and passes, the seed's network, solvers."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from zsdt.evaluation.bench import Case
from zsdt.tignn.cell_engine import CellEngine
from zsdt.tignn.engine import Engine
from zsdt.tignn.liquid_body import LiquidBody
from zsdt.tignn.liquid_engine import LiquidEngine
from zsdt.tignn.liquid_model import LiquidModel
from zsdt.tignn.model import NodeModel
from zsdt.tignn.node_engine import NodeEngine
from zsdt.tignn.options import Bracket, Energy, TignnOptions
from zsdt.tignn.particle_engine import ParticleEngine
from zsdt.tignn.seed_engine import SeedEngine, SeedModel, SeedScales, literal_options
from zsdt.tignn.seed_train import scales_of
from zsdt.trajectory import Trajectory

PASSES, WIDTHS = (2, 4, 8, 12), (32, 64, 128)
TIME_ONLY = "time only"
ERRORS = ("displacement_rrmse", "velocity_rrmse", "stress_rrmse", "energy_increment_rrmse")


@dataclass(frozen=True)
class Judged:
    """What was found of a trained method or a solver by full rollouts: `<error>` and `<error>_worst` (fractions) over
    `trajectories`."""

    errors: Mapping[str, float] = field(default_factory=dict)
    trajectories: int = 0


@dataclass(frozen=True)
class Entry:
    """A method that can be timed on bodies of a scene: `make` gives its engine anew, `judged` is by regime."""

    method: str
    make: Callable[[], Engine]
    judged: Mapping[str, Judged]
    note: str = ""


def card_of_engine(engine: Any) -> dict[str, Any]:
    """form, bracket, passes, width, context and parameters of an engine; empty where it has no such thing."""
    model = getattr(engine, "model", None)
    if model is None:
        form = {"CellEngine": "cell", "ParticleEngine": "particle"}.get(type(engine).__name__, "solver")
        return {"form": form, "bracket": "", "passes": "", "width": "", "context": "", "parameters": ""}
    options: TignnOptions = model.options
    return {
        "form": "seed" if isinstance(model, SeedModel) else "node",
        "bracket": options.bracket.value,
        "passes": options.passes,
        "width": options.width,
        "context": int(options.global_context and not isinstance(model, SeedModel)),
        "parameters": sum(p.numel() for p in model.parameters()),
    }


def pairs_of(engine: Any, trajectory: Trajectory) -> int:
    """Undirected pairs of the graph that the engine has at the first frame of a trajectory."""
    body = trajectory.body
    if body.liquid is None:
        return len(body.pairs)
    if isinstance(engine, ParticleEngine):
        reach = engine.profiles.cutoff * body.pitch
    elif getattr(engine, "model", None) is not None:
        links = LiquidBody(body, engine.model.options).connect(trajectory.fields["position"][0])
        return len(links.pairs)
    else:
        reach = 2.0 * 1.4 * body.pitch  # the solver's kernel
    tree = cKDTree(trajectory.fields["position"][0])
    return int((tree.count_neighbors(tree, reach) - body.nodes) // 2)


def case_of(entry: Entry, scene: str, regime: str, trajectory: Trajectory, resolution: float = 1.0) -> Case:
    """The case of an entry on a trajectory, with what a row says of it."""
    engine = entry.make()
    judged = entry.judged.get(regime, Judged())
    card: dict[str, Any] = {
        "scene": scene,
        "regime": regime,
        "body": trajectory.name,
        "method": entry.method,
        **card_of_engine(engine),
        "backend": backend_of(engine),
        "resolution": resolution,
        "pitch_m": trajectory.body.pitch * resolution,
        "planar": 0,
        "pairs": pairs_of(engine, trajectory),
        "trained": int(bool(judged.errors)),
        "trajectories": judged.trajectories,
        **{f"{name}{tail}": judged.errors.get(f"{name}{tail}", np.nan) for name in ERRORS for tail in ("", "_worst")},
        "note": entry.note,
    }
    return Case(entry.make, trajectory, card)


def network_variants(
    engine: NodeEngine | LiquidEngine, passes: Sequence[int] = PASSES, widths: Sequence[int] = WIDTHS
) -> Iterable[Entry]:
    """Untrained networks of all brackets, passes and widths on the scales of a trained one, and some without context:
    the time of a frame does not depend on what the weights are."""
    options, scales = engine.model.options, engine.model.scales
    grid = itertools.product(Bracket, passes, widths, (True,))
    for bracket, depth, width, context in itertools.chain(grid, ((Bracket.exact, p, 64, False) for p in passes)):
        changed = replace(
            options,
            bracket=bracket,
            energy=Energy.learned,
            passes=depth,
            local_passes=max(depth // 2, 1),
            width=width,
            global_context=context,
        )
        yield Entry(f"node {bracket.value}", _maker(engine, changed, scales), {}, TIME_ONLY)


def _maker(engine: NodeEngine | LiquidEngine, options: TignnOptions, scales: Any) -> Callable[[], Engine]:
    if isinstance(engine, NodeEngine):
        return lambda: NodeEngine(NodeModel(options, scales))
    return lambda: LiquidEngine(LiquidModel(options, scales))


def seed_variants(trajectories: Sequence[Trajectory]) -> Iterable[Entry]:
    """The seed's network to the letter with untrained weights: shared by all passes (its 299k parameters), and own."""
    scales = scales_of(list(trajectories))
    for method, shared in (("seed literal", True), ("seed literal, own weights per pass", False)):
        options = literal_options(shared_weights=shared)
        yield Entry(method, partial(_untrained_seed, options, scales), {}, TIME_ONLY)


def _untrained_seed(options: TignnOptions, scales: SeedScales) -> Engine:
    return SeedEngine(SeedModel(options, scales))


def backend_of(engine: Any) -> str:
    """Name of the backend that an engine has as it is loaded; empty for what is no trained engine."""
    if isinstance(engine, ParticleEngine):
        return "kernel" if engine.single else "eager"
    if isinstance(engine, CellEngine):
        return "kernel"
    return "eager" if getattr(engine, "model", None) is not None else ""


def on_backends(entry: Entry, but: Sequence[str] = ()) -> dict[str, Callable[[], Engine]]:
    """Makers of the same engine on every other inference backend that runs here, by its name; `but`: not these."""
    from zsdt.interop.inference import backends, with_backend

    engine = entry.make()
    if not isinstance(engine, NodeEngine | LiquidEngine | ParticleEngine):
        return {}
    left = (*but, backend_of(engine))

    def make(name: str) -> Engine:
        return with_backend(entry.make(), name)

    return {name: partial(make, name) for name in backends(engine) if name not in left}
