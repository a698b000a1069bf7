"""Training of the node form of liquids: relative loss, push-forward over graphs made anew, choice by rollout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from zsdt.errors import RunRejected
from zsdt.tignn.choice import judge_of
from zsdt.tignn.liquid_data import LiquidClip, LiquidStart, LiquidStream, clip_of, scales_of
from zsdt.tignn.liquid_engine import LiquidEngine, load_model, save_engine
from zsdt.tignn.liquid_features import LiquidBatch, look, merge_liquids
from zsdt.tignn.liquid_model import LiquidModel, advance
from zsdt.tignn.message_passing import receptive_field
from zsdt.tignn.options import TignnOptions, TrainingOptions
from zsdt.tignn.parallel import portion
from zsdt.tignn.train import EngineTraining, begin_training, fit, log, take_weights

FIELDS = ("displacement", "velocity", "internal_energy")
FLOOR = 0.1  # of a scale: increments smaller than this are not weighed up any further


class LiquidTraining(EngineTraining):
    """Loss of the node form of liquids."""

    model: LiquidModel

    def training_step(self, starts: list[LiquidStart], index: int) -> torch.Tensor:
        """Push-forward without gradient, then the errors of the increments of one step, each graph weighed by the
        size of its own (relative_loss); the error is a mean over graphs, the penalty one over nodes."""
        batches, targets = zip(*(self._window(start) for start in starts), strict=True)
        batch = merge_liquids(list(batches))
        rates = self.model(batch)
        off = (rates.total[:, -4:] - torch.cat(targets)) * batch.fluid
        velocity, energy = off[:, :3].square(), off[:, 3:].square()
        weight_v, weight_e = self._weights(batches, targets)
        share = batch.share * (len(off) / batch.bodies)
        parts = {
            "velocity": (velocity * weight_v * share).mean(),
            "energy": self.model.options.liquid.energy_weight * (energy * weight_e * share).mean(),
        }
        graphs, penalty = portion(batch.bodies), rates.penalty
        if penalty is not None:
            penalty = portion(batch.graph.nodes) * penalty
        return self.combined({name: graphs * part for name, part in parts.items()}, penalty, self.model.options)

    def _window(self, start: LiquidStart) -> tuple[LiquidBatch, torch.Tensor]:
        """The moment whose step is learned, and the true increments from it in their scales."""
        clip, state, model = start.clip, start.state, self.model
        at = start.frame
        for _ in range(start.unroll - 1):
            load = 0.5 * (clip.load[at] + clip.load[at + 1])
            at += 1
            try:
                state = advance(model, clip.body, state, load, relax=False).state
            except RunRejected:  # an early network may blow up: it learns from the true state of this frame instead
                state = clip.state(at)
        load = 0.5 * (clip.load[at] + clip.load[at + 1])
        batch = look(clip.body, state, load, model.scales, model.options.global_context)
        target = torch.zeros(batch.graph.nodes, 4)
        dv = (clip.velocity[at + 1] - state.velocity) / model.scales.d_velocity
        de = (clip.energy[at + 1] - clip.energy[at]) / model.scales.d_energy
        target[: clip.body.fluids] = torch.as_tensor(np.concatenate([dv, de], axis=1), dtype=torch.float32)
        return batch, target

    def _weights(self, batches, targets) -> tuple[torch.Tensor, torch.Tensor]:
        if not self.training_options.relative_loss:
            ones = torch.ones(sum(len(t) for t in targets), 1)
            return ones, ones
        rows = []
        for batch, target in zip(batches, targets, strict=True):
            fluids = batch.fluid.sum()
            square = torch.stack([target[:, :3].square().sum() / (3.0 * fluids), target[:, 3].square().sum() / fluids])
            rows.append((1.0 / (square + FLOOR**2)).expand(len(target), 2))
        both = torch.cat(rows)
        return both[:, :1], both[:, 1:]


def train_liquid(
    dataset_folder: str | Path,
    options: TignnOptions,
    training: TrainingOptions,
    out: str | Path,
    scratch: str | Path,
    warm_start: str | Path | None = None,
) -> dict[str, Any]:
    """Trains the node form on liquids; see `zsdt.tignn.train.train_engine`.

    `augment` is not read: predictions turn and mirror with the liquid by construction.
    """
    scratch, out = Path(scratch), Path(out)
    train, held = begin_training(dataset_folder, training, scratch)
    clips = [clip_of(t, options) for t in train]
    model = LiquidModel(options, scales_of(clips))
    if warm_start is not None:
        take_weights(model, load_model(warm_start), warm_start)
    bound = _print_bound(options, clips)
    stream = LiquidStream(clips, model.scales, training)
    figures = fit(LiquidTraining(model, training), stream, judge_of(LiquidEngine, held, FIELDS), scratch, out)
    save_engine(model, out)
    return figures | {"receptive_field": bound, "held_out": [t.name for t in held]}


def _print_bound(options: TignnOptions, clips: list[LiquidClip]) -> str:
    """Depth against what the physics asks for, of the largest liquid."""
    clip = max(clips, key=lambda c: float(np.ptp(c.position[0], axis=0).max()) / c.body.pitch)
    length = float(np.ptp(clip.position[0], axis=0).max())
    hop = options.liquid.cutoff * clip.body.pitch
    line = receptive_field(options.passes, hop, clip.body.frame_dt, length, clip.body.liquid.sound_speed)
    log.info("receptive field: %s%s", line, "; a virtual node spans the graph" if options.global_context else "")
    return line
