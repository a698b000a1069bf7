"""What training costs: seconds per 1,000 optimiser steps, measured on a few of them in this process."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from zsdt.evaluation.bench import Progress
from zsdt.tignn import liquid_data, node_data, seed_train
from zsdt.tignn.liquid_model import LiquidModel
from zsdt.tignn.liquid_train import LiquidTraining
from zsdt.tignn.model import NodeModel
from zsdt.tignn.options import Form, TignnOptions, TrainingOptions
from zsdt.tignn.seed_engine import SeedModel
from zsdt.tignn.train import EngineTraining, NodeTraining
from zsdt.trajectory import Trajectory

SECONDS, FEWEST, MOST = 2.0, 2, 40


def training_costs(
    options: Mapping[str, TignnOptions],
    trajectories: Sequence[Trajectory],
    batch: int = 2,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """One row per named network: method, passes, width, parameters, batch, steps timed, seconds_per_1000_steps.

    One-step training (no push-forward), all in: sample, noise, forward, backward, optimiser.
    """
    rows = []
    for name, chosen in options.items():
        module, stream = _prepared(chosen, list(trajectories), TrainingOptions(steps=1000, batch=batch, unroll=1))
        seconds, steps = _seconds_per_step(module, stream)
        rows.append(
            {
                "method": name,
                "passes": chosen.passes,
                "width": chosen.width,
                "parameters": sum(p.numel() for p in module.model.parameters()),
                "batch": batch,
                "nodes": trajectories[0].body.nodes,
                "timed_steps": steps,
                "seconds_per_1000_steps": 1000.0 * seconds,
            }
        )
        if progress is not None:
            progress(name)
    return rows


def _prepared(
    options: TignnOptions, trajectories: list[Trajectory], training: TrainingOptions
) -> tuple[EngineTraining, Any]:
    """Module and stream of samples of a network, whatever its form."""
    if options.form is Form.seed:
        seed = SeedModel(options, seed_train.scales_of(trajectories))
        clips = [seed_train.clip_of(t, seed) for t in trajectories]
        return seed_train.SeedTraining(seed, training), seed_train.SeedStream(clips, seed, training)
    if trajectories[0].body.liquid is not None:
        liquids = [liquid_data.clip_of(t, options) for t in trajectories]
        liquid = LiquidModel(options, liquid_data.scales_of(liquids))
        return LiquidTraining(liquid, training), liquid_data.LiquidStream(liquids, liquid.scales, training)
    node = NodeModel(options, node_data.scales_of(trajectories, options))
    solids = [node_data.clip_of(t, options) for t in trajectories]
    return NodeTraining(node, training), node_data.SampleStream(solids, node.scales, options, training)


def _seconds_per_step(module: Any, stream: Any) -> tuple[float, int]:
    """Mean over as many steps as `SECONDS` allow, after one that is not counted."""
    optimizer = torch.optim.AdamW(module.model.parameters(), lr=1e-4, fused=True)
    module.model.train()

    def step(k: int) -> None:
        loss = module.training_step(stream.sample(k), 0)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(module.model.parameters(), 1.0)
        optimizer.step()

    step(0)
    began, done = time.perf_counter(), 0
    while done < FEWEST or (done < MOST and time.perf_counter() - began < SECONDS):
        done += 1
        step(done)
    return (time.perf_counter() - began) / done, done
