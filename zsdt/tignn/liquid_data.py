"""Training data of the node form of liquids: trajectories in memory, scales, noise, starts of push-forward windows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch.utils.data import IterableDataset

from zsdt.errors import DataError
from zsdt.tignn.liquid_body import LiquidBody
from zsdt.tignn.liquid_features import LiquidScales, LiquidState
from zsdt.tignn.options import NoiseKind, TignnOptions, TrainingOptions
from zsdt.tignn.parallel import own_graphs
from zsdt.trajectory import Trajectory

# Noise on positions, in spacings, per unit of noise on velocities (in velocity scales).
POSITION_SHARE = 0.5
# This share of the windows is taken from the first third of a trajectory, where a stop does most of what it does.
EARLY = 0.5


@dataclass(frozen=True)
class LiquidClip:
    """A trajectory ready for training: its body and fields, float64 SI arrays [frames, fluids, components]."""

    name: str
    body: LiquidBody
    position: Float[np.ndarray, "frames fluids 3"]
    velocity: Float[np.ndarray, "frames fluids 3"]
    energy: Float[np.ndarray, "frames fluids 1"]
    load: Float[np.ndarray, "frames fluids 3"]

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.position)

    def state(self, frame: int) -> LiquidState:
        """The true state of a frame."""
        return LiquidState(self.position[frame], self.velocity[frame], self.energy[frame])


def clip_of(trajectory: Trajectory, options: TignnOptions) -> LiquidClip:
    """Raises: DataError where the trajectory is no liquid in a vessel or lacks a field."""
    missing = {"position", "velocity", "internal_energy"} - set(trajectory.fields)
    if missing:
        raise DataError(f"{trajectory.name} lacks {', '.join(sorted(missing))}; the node form of liquids needs them.")
    f = trajectory.fields
    body = LiquidBody(trajectory.body, options)
    return LiquidClip(
        trajectory.name, body, f["position"], f["velocity"], f["internal_energy"], np.asarray(trajectory.load, float)
    )


def scales_of(clips: list[LiquidClip]) -> LiquidScales:
    """Root mean squares over all clips. Raises: DataError where there are none."""
    if not clips:
        raise DataError("The data set has no training trajectories; make some or correct the split in index.csv.")

    def rms(parts: list[np.ndarray]) -> float:
        total, count = sum(float(np.square(p).sum()) for p in parts), sum(p.size for p in parts)
        return max(float(np.sqrt(total / count)), 1e-12)

    liquids = [c.body.liquid for c in clips]
    return LiquidScales(
        velocity=rms([c.velocity for c in clips]),
        energy=rms([c.energy for c in clips]),
        d_velocity=rms([np.diff(c.velocity, axis=0) for c in clips]),
        d_energy=rms([np.diff(c.energy, axis=0) for c in clips]),
        frame_dt=float(np.median([c.body.frame_dt for c in clips])),
        viscosity=max(float(np.median([x.viscosity / x.density for x in liquids])), 1e-9),
    )


@dataclass(frozen=True)
class LiquidStart:
    """Where a push-forward begins: the clip, its frame, a (noisy) state, and how many steps follow until the one that
    is learned, that one included."""

    clip: LiquidClip
    frame: int
    state: LiquidState
    unroll: int


class LiquidStream(IterableDataset):
    """Endless batches of starts; the k-th depends on the seed and k alone, so a resumed run sees the same."""

    def __init__(self, clips: list[LiquidClip], scales: LiquidScales, training: TrainingOptions, start: int = 0):
        self.clips, self.scales, self.training, self.start = clips, scales, training, start
        self.shortest = min(c.frames for c in clips)

    def __iter__(self) -> Iterator[list[LiquidStart]]:
        for step in range(self.start, self.training.steps):
            yield self.sample(step)

    def sample(self, step: int) -> list[LiquidStart]:
        """What an optimiser step learns from: `batch` starts, or those of them that are this process's own."""
        draw = np.random.default_rng((self.training.seed, step))
        late = step >= self.training.unroll_from * self.training.steps
        unroll = int(draw.integers(1, self.training.unroll + 1)) if late else 1
        unroll = min(unroll, self.shortest - 1)
        return [self._start(draw, unroll) for _ in range(self.training.batch)][own_graphs(self.training.batch)]

    def _start(self, draw: np.random.Generator, unroll: int) -> LiquidStart:
        clip = self.clips[int(draw.integers(len(self.clips)))]
        most = clip.frames - unroll
        if draw.random() < EARLY:
            most = max(most // 3, 1)
        frame = int(draw.integers(most))
        return LiquidStart(clip, frame, self._disturbed(clip, clip.state(frame), draw), unroll)

    def _disturbed(self, clip: LiquidClip, state: LiquidState, draw: np.random.Generator) -> LiquidState:
        """additive: independent noise and a common drift, of a random strength, the target corrected.
        multiplicative (seed): velocities times 1 + noise."""
        noise = self.training.noise
        if noise == 0.0:
            return state
        normal = draw.normal(size=state.velocity.shape)
        if self.training.noise_kind is NoiseKind.multiplicative:
            return LiquidState(state.position, state.velocity * (1.0 + noise * normal), state.energy)
        strength = noise * draw.random()
        drift = draw.normal(size=3)
        velocity = state.velocity + strength * self.scales.velocity * (normal + drift)
        apart = strength * POSITION_SHARE * clip.body.pitch * draw.normal(size=state.position.shape)
        position, _, _ = clip.body.keep_inside(state.position + apart, velocity)
        return LiquidState(position, velocity, state.energy)
