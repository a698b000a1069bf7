"""Training data of the node form: trajectories in memory, scales, noise, and batches of graphs of different bodies."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import lightning as L
import numpy as np
import torch
from torch.utils.data import DataLoader, IterableDataset

from zsdt.errors import DataError, OptionError
from zsdt.tignn.augment import section_symmetries, turn_batch, turn_load, turn_state
from zsdt.tignn.features import (
    STRESS_BASIS,
    GraphBatch,
    NodeState,
    Scales,
    body_batch,
    cut,
    graph_magnitude,
    join,
    merge,
)
from zsdt.tignn.model import start_state
from zsdt.tignn.options import Energy, NoiseKind, TignnOptions, TrainingOptions
from zsdt.tignn.parallel import own_graphs
from zsdt.trajectory import Trajectory

# Errors of a rollout are smooth: a factor common to a whole graph is this much larger than the noise per node.
COMMON = 3.0


@dataclass(frozen=True)
class Clip:
    """A trajectory as tensors: its graph, a state and a load [nodes, 3] per frame, and the root mean squares of its
    own velocity [m/s] and stress [Pa] over all frames (what its errors are held against)."""

    name: str
    batch: GraphBatch
    states: list[NodeState]
    loads: torch.Tensor
    velocity_rms: float
    stress_rms: float


@dataclass(frozen=True)
class Sample:
    """What one optimiser step learns from: graphs side by side, the (noisy) state, loads [unroll + 1, nodes, 3], the
    true state at the end, and per node the weights of the errors of velocity and stress [nodes, 1]."""

    batch: GraphBatch
    state: NodeState
    loads: torch.Tensor
    target: NodeState
    velocity_weight: torch.Tensor
    stress_weight: torch.Tensor


def require_energies(trajectory: Trajectory, options: TignnOptions) -> None:
    """Raises: OptionError where energy=physical and the data set lacks what that energy is made of."""
    if options.energy is not Energy.physical:
        return
    energies = {"elastic_energy", "dissipated_energy"} <= set(trajectory.fields)
    if not energies or trajectory.body.material is None or not trajectory.body.mass.any():
        raise OptionError(
            f"energy=physical needs masses, a material and energy densities, which {trajectory.name} does not have; "
            "use energy=learned for this data set."
        )


def clip_of(trajectory: Trajectory, options: TignnOptions) -> Clip:
    """Tensors of a trajectory. Raises: OptionError (see `require_energies`)."""
    require_energies(trajectory, options)
    batch = body_batch(trajectory.body)
    states = [start_state(batch, trajectory.body.points, trajectory.at(k), options) for k in range(trajectory.frames)]
    return Clip(
        name=trajectory.name,
        batch=batch,
        states=_with_increments(states, options.history),
        loads=torch.as_tensor(trajectory.load, dtype=torch.float32),
        velocity_rms=_rms([trajectory.fields["velocity"]]),
        stress_rms=_rms([trajectory.fields["stress"]]),
    )


def _with_increments(states: list[NodeState], history: int) -> list[NodeState]:
    if history == 0:
        return states
    velocities = [s.velocity for s in states]
    rows = []
    for k, state in enumerate(states):
        past = [velocities[j] - velocities[j - 1] if j > 0 else torch.zeros_like(velocities[0])
                for j in range(k, k - history, -1)]  # fmt: skip
        rows.append(replace(state, increments=torch.cat(past, dim=1)))
    return rows


def _rms(parts: list[np.ndarray]) -> float:
    total = sum(float(np.square(p, dtype=np.float64).sum()) for p in parts)
    count = sum(p.size for p in parts)
    return max(float(np.sqrt(total / max(count, 1))), 1e-12)


def scales_of(trajectories: list[Trajectory], options: TignnOptions) -> Scales:
    """Root mean squares of the fields, of what edges see of them, and of one frame's increments.

    Raises: OptionError (see `require_energies`).
    """
    for trajectory in trajectories:
        require_energies(trajectory, options)
    strain, rate, load, stress, d_stress, velocity, d_velocity, thermal, volumes = ([] for _ in range(9))
    for trajectory in trajectories:
        body, field = trajectory.body, trajectory.fields
        first, second = body.pairs.T
        moved = field["position"] - body.points
        strain.append((moved[:, second] - moved[:, first]) / body.pitch)
        rate.append((field["velocity"][:, second] - field["velocity"][:, first]) / body.pitch)
        pushed = trajectory.load[np.abs(trajectory.load).sum(-1) > 0]
        load.append(np.linalg.norm(pushed, axis=-1) if len(pushed) else np.zeros(0))
        stress.append(field["stress"] @ STRESS_BASIS.T)
        d_stress.append(np.diff(stress[-1], axis=0))
        velocity.append(field["velocity"])
        d_velocity.append(np.diff(field["velocity"], axis=0))
        if options.energy is Energy.physical:
            thermal.append(np.concatenate([field["elastic_energy"], field["dissipated_energy"]], axis=-1))
            assert body.material is not None
            volumes.append(body.mass / body.material.density)

    def stress_scales(parts: list[np.ndarray]) -> tuple[float, float]:
        if not options.split_pressure:
            return (_rms(parts),) * 2
        return _rms([p[..., :1] for p in parts]), _rms([p[..., 1:] for p in parts])

    pressure, deviator = stress_scales(stress)
    d_pressure, d_deviator = stress_scales(d_stress)
    return Scales(
        velocity=_rms(velocity),
        pressure=pressure,
        deviator=deviator,
        strain=_rms(strain),
        rate=_rms(rate),
        load=_rms(load) if any(p.size for p in load) else 1.0,
        thermal=_rms(thermal) if thermal else 1.0,
        d_velocity=_rms(d_velocity),
        d_pressure=d_pressure,
        d_deviator=d_deviator,
        d_thermal=_rms([np.diff(t, axis=0) for t in thermal]) if thermal else 1.0,
        frame_dt=float(np.median([t.body.frame_dt for t in trajectories])),
        node_volume=_rms(volumes) if volumes else 1.0,
    )


def disturb(
    batch: GraphBatch,
    state: NodeState,
    scales: Scales,
    magnitude: torch.Tensor,
    training: TrainingOptions,
    chance: torch.Generator,
) -> NodeState:
    """The state with noise. The target stays the true next state, so the network learns to undo the noise.

    additive: independent noise per node plus a random factor per graph (rollout errors are smooth), both of a random
    strength per graph. multiplicative (seed): every component times 1 + noise.
    """

    def normal(like: torch.Tensor) -> torch.Tensor:
        return torch.randn(like.shape, generator=chance)

    def graph_normal(columns: int = 1) -> torch.Tensor:
        return torch.randn(batch.bodies, columns, generator=chance)[batch.member]

    noise, strong = training.noise, training.stress_noise
    if training.noise_kind is NoiseKind.multiplicative:
        return replace(
            state,
            velocity=state.velocity * (1.0 + noise * normal(state.velocity)),
            stress=state.stress * (1.0 + strong * normal(state.stress)),
            increments=state.increments * (1.0 + noise * normal(state.increments)),
        )
    strength = torch.rand(batch.bodies, 1, generator=chance)[batch.member]
    size = noise * strength * magnitude
    common_share = COMMON * noise * strength
    velocity = state.velocity * (1.0 + common_share * graph_normal())
    velocity = velocity + size * scales.velocity * normal(velocity) * batch.free
    displacement = state.displacement * (1.0 + common_share * graph_normal())
    displacement = displacement + size * scales.strain * batch.pitch * normal(displacement) * batch.free
    basis = torch.tensor(STRESS_BASIS, dtype=torch.float32)
    coordinates = state.stress @ basis.T
    common = graph_normal(2) * strong * torch.rand(batch.bodies, 1, generator=chance)[batch.member]
    coordinates = coordinates * (1.0 + torch.cat([common[:, :1], common[:, 1:].expand(-1, 5)], dim=1))
    spread = (
        torch.tensor(scales.stress()) * magnitude * strong * torch.rand(batch.bodies, 1, generator=chance)[batch.member]
    )
    stress = (coordinates + spread * normal(coordinates)) @ torch.linalg.inv(basis).T
    increments = state.increments + strength * training.noise * scales.velocity * magnitude * normal(state.increments)
    return replace(state, displacement=displacement, velocity=velocity, stress=stress, increments=increments)


class SampleStream(IterableDataset):
    """Endless samples; the k-th depends on the seed and k alone, so a resumed run sees what it would have seen."""

    def __init__(
        self, clips: list[Clip], scales: Scales, options: TignnOptions, training: TrainingOptions, start: int = 0
    ):
        self.clips, self.scales, self.options, self.training, self.start = clips, scales, options, training, start
        if not clips:
            raise DataError("The data set has no training trajectories; make some or correct the split in index.csv.")
        self.turns = section_symmetries()

    def __iter__(self) -> Iterator[Sample]:
        for step in range(self.start, self.training.steps):
            yield self.sample(step)

    def unroll_at(self, step: int, draw: np.random.Generator) -> int:
        """Length of the push-forward at a step: 1 at first, then 1 ... unroll."""
        if step < self.training.unroll_from * self.training.steps:
            return 1
        return int(draw.integers(1, self.training.unroll + 1))

    def sample(self, step: int) -> Sample:
        """The sample of an optimiser step, or the graphs of it that are this process's own."""
        draw = np.random.default_rng((self.training.seed, step))
        chance = torch.Generator().manual_seed(int(draw.integers(2**62)))
        unroll = self.unroll_at(step, draw)
        unroll = min(unroll, min(len(c.states) for c in self.clips) - 1)
        picks = [self._pick(draw, unroll) for _ in range(self.training.batch)]
        batch, state = merge([p.batch for p in picks]), join([p.state for p in picks])
        load = torch.cat([p.loads for p in picks], dim=1)
        magnitude = graph_magnitude(batch, state, load[1], self.scales, self.options.graph_scale)
        noisy = disturb(batch, state, self.scales, magnitude, self.training, chance)
        target = join([p.target for p in picks])
        velocity, stress = (torch.cat([getattr(p, n) for p in picks]) for n in ("velocity_weight", "stress_weight"))
        mine = own_graphs(len(picks))
        if mine == slice(0, len(picks)):
            return Sample(batch, noisy, load, target, velocity, stress)
        sizes = [p.batch.graph.nodes for p in picks]
        at = slice(sum(sizes[: mine.start]), sum(sizes[: mine.stop]))
        batch, noisy, target = merge([p.batch for p in picks[mine]]), cut(noisy, at), cut(target, at)
        return Sample(batch, noisy, load[:, at], target, velocity[at], stress[at])

    def _pick(self, draw: np.random.Generator, unroll: int) -> Sample:
        """One clean window of one trajectory, turned by a random symmetry of the cross-section."""
        clip = self.clips[int(draw.integers(len(self.clips)))]
        at = int(draw.integers(len(clip.states) - unroll))
        batch, state, target = clip.batch, clip.states[at], clip.states[at + unroll]
        loads = clip.loads[at : at + unroll + 1]
        if self.training.augment:
            turn = self.turns[int(draw.integers(len(self.turns)))]
            batch, loads = turn_batch(batch, turn), turn_load(loads, turn)
            state, target = turn_state(state, turn), turn_state(target, turn)
        velocity, stress = (torch.full_like(batch.free, weight) for weight in self._weights(clip))
        return Sample(batch, state, loads, target, velocity, stress)

    def _weights(self, clip: Clip) -> tuple[float, float]:
        """One over the expected square error of velocity and stress of an untrained network on this clip."""
        scales, strong = self.scales, self.training.stress_noise
        stress = float(np.mean(np.square(scales.stress())))
        d_stress = float(np.mean(np.square(scales.d_stress())))
        factors = (1.0, 1.0)
        if self.training.relative_loss:
            factors = (clip.velocity_rms / scales.velocity, clip.stress_rms / np.sqrt(stress))
        return (
            1.0 / (scales.d_velocity * factors[0]) ** 2,
            1.0 / ((d_stress + strong**2 * stress) * factors[1] ** 2),
        )


class NodeData(L.LightningDataModule):
    """Lightning's view of the stream of samples."""

    def __init__(self, stream: IterableDataset):
        super().__init__()
        self.stream = stream

    def train_dataloader(self) -> DataLoader:
        """One sample per step, made in this process (one worker per core is all there is)."""
        return DataLoader(self.stream, batch_size=None)

    def transfer_batch_to_device(self, batch, device, dataloader_idx):
        """Samples live on the CPU, where the fused kernel runs."""
        return batch
