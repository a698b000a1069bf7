"""Training of the seed's literal network on both scenes: one-step rates, multiplicative noise, soft degeneracy.

Optimiser, checkpoints and the choice of the weights are those of the other forms, so that only the network differs.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import IterableDataset

from zsdt.tignn.choice import judge_of
from zsdt.tignn.options import TignnOptions, TrainingOptions
from zsdt.tignn.seed_engine import (
    LIQUID,
    SOLID,
    SeedBody,
    SeedEngine,
    SeedGraph,
    SeedModel,
    SeedScales,
    load_model,
    save_engine,
    with_walls,
)
from zsdt.tignn.train import EngineTraining, begin_training, fit, take_weights
from zsdt.trajectory import Trajectory


@dataclass(frozen=True)
class SeedSample:
    """Graphs side by side: scaled (noisy) state z, force, target rate [nodes, d], and 1 for the nodes that are judged
    [nodes, 1]."""

    z: torch.Tensor
    force: torch.Tensor | None
    graph: SeedGraph
    target: torch.Tensor
    judged: torch.Tensor


@dataclass(frozen=True)
class _Clip:
    """A trajectory in scaled units: states [frames, nodes, d], forces [frames, nodes, 3] (None of a liquid)."""

    body: SeedBody
    states: torch.Tensor
    forces: torch.Tensor | None


def scales_of(trajectories: list[Trajectory]) -> SeedScales:
    """Mean and standard deviation of every component over all frames and nodes; 1 where a component never changes."""
    liquid = trajectories[0].body.liquid is not None
    names = LIQUID if liquid else SOLID

    def moments(parts: list[np.ndarray]) -> tuple[list[float], list[float]]:
        values = np.concatenate([p.reshape(-1, p.shape[-1]) for p in parts])
        spread = values.std(axis=0)
        return values.mean(axis=0).tolist(), np.where(spread > 0, spread, 1.0).tolist()

    mean, spread = moments([np.concatenate([t.fields[n] for n in names], axis=-1) for t in trajectories])
    if liquid:
        return SeedScales(mean, spread, [], [])
    return SeedScales(mean, spread, *moments([np.asarray(t.load, float) for t in trajectories]))


def clip_of(trajectory: Trajectory, model: SeedModel) -> _Clip:
    """A trajectory ready for training."""
    states = torch.stack([model.scaled(trajectory.at(k)) for k in range(trajectory.frames)])
    forces = None
    if model.fields is SOLID:
        found = [model.scaled_force(load) for load in trajectory.load]
        forces = torch.stack([f for f in found if f is not None])
    return _Clip(SeedBody(trajectory.body, model), states, forces)


class SeedStream(IterableDataset):
    """Endless samples; the k-th depends on the seed and k alone, so a resumed run sees what it would have seen."""

    def __init__(self, clips: list[_Clip], model: SeedModel, training: TrainingOptions, start: int = 0):
        self.clips, self.model, self.training, self.start = clips, model, training, start

    def __iter__(self) -> Iterator[SeedSample]:
        for step in range(self.start, self.training.steps):
            yield self.sample(step)

    def sample(self, step: int) -> SeedSample:
        """What an optimiser step learns from."""
        draw = np.random.default_rng((self.training.seed, step))
        chance = torch.Generator().manual_seed(int(draw.integers(2**62)))
        return _merge([self._pick(draw, chance) for _ in range(self.training.batch)])

    def _pick(self, draw: np.random.Generator, chance: torch.Generator) -> SeedSample:
        """One moment of one trajectory, its state times 1 + noise, and the rate that leads to the true next state."""
        clip = self.clips[int(draw.integers(len(self.clips)))]
        at = int(draw.integers(len(clip.states) - 1))
        body, clean, after = clip.body.body, clip.states[at], clip.states[at + 1]
        z = clean * (1.0 + self.training.noise * torch.randn(clean.shape, generator=chance))
        graph, walls = clip.body.graph(self.model.split(clean)["position"])
        target = (after - z) / body.frame_dt
        z = with_walls(self.model, z, walls)
        judged = torch.zeros(len(z), 1)
        judged[: len(clean), 0] = torch.from_numpy(~body.clamped).to(judged.dtype)
        target = torch.cat([target, torch.zeros(len(z) - len(clean), target.shape[1])])
        return SeedSample(z, None if clip.forces is None else clip.forces[at + 1], graph, target, judged)


def _merge(parts: list[SeedSample]) -> SeedSample:
    """Samples side by side."""
    starts = np.cumsum([0] + [len(p.z) for p in parts])
    graph = SeedGraph(
        to=torch.cat([p.graph.to + int(s) for p, s in zip(parts, starts, strict=False)]),
        source=torch.cat([p.graph.source + int(s) for p, s in zip(parts, starts, strict=False)]),
        kind=torch.cat([p.graph.kind for p in parts]),
    )
    forces = [p.force for p in parts if p.force is not None]
    z, target, judged = (torch.cat([getattr(p, name) for p in parts]) for name in ("z", "target", "judged"))
    return SeedSample(z, torch.cat(forces) if forces else None, graph, target, judged)


class SeedTraining(EngineTraining):
    """Loss of the seed: `lambda_d * data + |M dE|2 + |L dS|2`."""

    model: SeedModel

    def training_step(self, sample: SeedSample, index: int) -> torch.Tensor:
        """Mean square error of the scaled rates of all judged nodes, and the degeneracy of the bulk."""
        rates = self.model(sample.z, sample.force, sample.graph)
        off = (rates.total - sample.target) * sample.judged
        data = off.square().sum() / (sample.judged.sum() * off.shape[1])
        return self.combined({"rate": data}, rates.penalty, self.model.options)


def train_seed(
    dataset_folder: str | Path,
    options: TignnOptions,
    training: TrainingOptions,
    out: str | Path,
    scratch: str | Path,
    warm_start: str | Path | None = None,
) -> dict[str, Any]:
    """Trains the seed's literal network; see `zsdt.tignn.train.train_engine`.

    noise is the standard deviation of the factor on every component. noise_kind, stress_noise, unroll, augment and
    relative_loss are not read: the seed has none of them.
    """
    scratch, out = Path(scratch), Path(out)
    train, held = begin_training(dataset_folder, training, scratch)
    model = SeedModel(options, scales_of(train))
    if warm_start is not None:
        take_weights(model, load_model(warm_start), warm_start)
    fields = ("displacement", "velocity", model.fields[2])
    stream = SeedStream([clip_of(t, model) for t in train], model, training)
    judge = judge_of(SeedEngine, held, fields)
    figures = fit(SeedTraining(model, training), stream, judge, scratch, out)
    save_engine(model, out)
    return figures | {"held_out": [t.name for t in held]}
