"""How well a learned bracket keeps its promises during a rollout, measured in double precision."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from zsdt.tignn.engine import Engine
from zsdt.trajectory import Trajectory


def degeneracy(engine: Engine, trajectory: Trajectory, frames: int = 4) -> dict[str, float]:
    """Worst figures of the engine's probe over the first steps of a rollout, as `probe_<name>`.

    Names and meaning as in `zsdt.tignn.node_engine.probe`: residuals are relative to the terms that they are sums
    of; `probe_entropy_production` must not be negative. Empty for methods without a bracket, and for networks in a
    runtime that their brackets do not leave.
    """
    from zsdt.tignn import cell_probe, liquid_engine, node_engine
    from zsdt.tignn.cell_engine import CellEngine

    if hasattr(getattr(engine, "model", None), "file"):
        return {}
    if isinstance(engine, liquid_engine.LiquidEngine):
        fluid = liquid_engine.LiquidEngine(copy.deepcopy(engine.model), engine.name, torch.float64)

        def look_at_liquid(run: liquid_engine.LiquidRun, loads: list[np.ndarray]) -> dict[str, float]:
            return liquid_engine.probe_liquid(fluid.model, fluid.body, run.state, 0.5 * (loads[0] + loads[1]))

        return _worst(fluid, trajectory, frames, look_at_liquid)
    if isinstance(engine, CellEngine):
        return _worst(engine, trajectory, frames, lambda state, loads: cell_probe.probe(engine, state))
    if not isinstance(engine, node_engine.NodeEngine):
        return {}
    double = node_engine.NodeEngine(copy.deepcopy(engine.model), engine.name, torch.float64)

    def look(run: node_engine.NodeRun, loads: list[np.ndarray]) -> dict[str, float]:
        return node_engine.probe(double.model, double.batch, run.state, *[torch.as_tensor(x) for x in loads])

    return _worst(double, trajectory, frames, look)


def _worst(
    engine: Any, trajectory: Trajectory, frames: int, look: Callable[[Any, list[np.ndarray]], dict[str, float]]
) -> dict[str, float]:
    """Worst of what `look(state, [load, next load])` finds along a rollout that stays within the numbers."""
    engine.prepare(trajectory.body)
    state = engine.start(trajectory.at(0), trajectory.load[0])
    worst: dict[str, float] = {}
    for frame in range(1, min(frames + 1, trajectory.frames)):
        loads = [trajectory.load[frame - 1], trajectory.load[frame]]
        for name, value in look(state, loads).items():
            pick = min if name == "entropy_production" else max
            worst[f"probe_{name}"] = pick(worst.get(f"probe_{name}", value), value)
        state = engine.step(state, *loads)
        if not np.isfinite(engine.read(state)["position"]).all():
            break
    return worst
