"""How well a learned bracket keeps its promises during a rollout, measured in double precision."""

from __future__ import annotations

import copy

import numpy as np
import torch

from zsdt.tignn.engine import Engine
from zsdt.trajectory import Trajectory


def degeneracy(engine: Engine, trajectory: Trajectory, frames: int = 4) -> dict[str, float]:
    """Worst figures of `zsdt.tignn.node_engine.probe` over the first steps of a rollout, as `probe_<name>`.

    Residuals are relative to the terms that they are sums of; `probe_entropy_production` must not be negative.
    Empty for methods that are no graph network in node form, or have no bracket.
    """
    from zsdt.tignn.node_engine import NodeEngine, probe

    if not isinstance(engine, NodeEngine):
        return {}
    double = NodeEngine(copy.deepcopy(engine.model), engine.name, torch.float64)
    double.prepare(trajectory.body)
    run = double.start(trajectory.at(0), trajectory.load[0])
    worst: dict[str, float] = {}
    for frame in range(1, min(frames + 1, trajectory.frames)):
        loads = trajectory.load[frame - 1], trajectory.load[frame]
        found = probe(double.model, double.batch, run.state, *[torch.as_tensor(x) for x in loads])
        for name, value in found.items():
            pick = min if name == "entropy_production" else max
            worst[f"probe_{name}"] = pick(worst.get(f"probe_{name}", value), value)
        run = double.step(run, *loads)
        if not np.isfinite(double.read(run)["position"]).all():
            break
    return worst
