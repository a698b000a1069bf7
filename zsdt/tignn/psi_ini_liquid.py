"""Psi_ini of a liquid: particle positions and how the vessel moved -> velocity and internal energy at the first frame.

A static encoder-processor-decoder (DESIGN 4.3; seed, IV.B and V.B: two hidden layers of 80). The velocity that a push
of the vessel leaves behind is potential flow first of all, which the walls and the free surface fix; it is solved for
(`zsdt.fluid.impulse`), and the network says how much of it viscosity has left and what else has grown. It decodes
scalars alone, by which vectors are combined (see `psi_ini_liquid_features`).

A trajectory has one first frame, but every later one is the first frame of a motion that ended with standing still for
longer: these are what the network is trained on as well.
"""

from __future__ import annotations

import logging
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from zsdt.errors import DataError, OptionError
from zsdt.tignn.message_passing import Perceptron, Processor
from zsdt.tignn.psi_ini_liquid_features import (
    BASIS,
    EDGE_FEATURES,
    LONG,
    NODE_FEATURES,
    LiquidInputs,
    inputs_of,
    merge_inputs,
)
from zsdt.tignn.psi_ini_training import card_of, keep, optimise
from zsdt.trajectory import Body, Dataset, DatasetEntry, Trajectory

log = logging.getLogger(__name__)

NO_ENERGY = 1e-12
LEAST = 0.05  # of the scales: errors of liquids that hardly move are not measured against less than this


@dataclass
class LiquidPsiIniOptions:
    """Network and training of the liquid's Psi_ini.

    passes, width, hidden_layers: of the processor. steps, batch, learning_rate: of the training. frames: which frames
    of a trajectory are trained on; frame k stands for a vessel that has stood still for k frames. first_share: share
    of draws that are the first one of them. check_every: steps between looks at the val liquids, whose best weights
    are kept.
    """

    passes: int = 2
    width: int = 80
    hidden_layers: int = 2
    steps: int = 1200
    batch: int = 2
    learning_rate: float = 2e-3
    frames: list[int] = field(default_factory=lambda: [0, 1, 2, 3, 4, 6, 9, 14])
    first_share: float = 0.3
    check_every: int = 100
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.passes, self.width, self.hidden_layers, self.steps, self.batch, self.check_every) < 1:
            raise OptionError("passes, width, hidden_layers, steps, batch and check_every of psi_ini must be positive.")
        if not self.frames or min(self.frames) < 0:
            raise OptionError("frames of psi_ini must name at least one frame, counted from 0.")
        if not 0.0 <= self.first_share <= 1.0:
            raise OptionError(f"first_share = {self.first_share} must be a share between 0 and 1.")


class LiquidPsiIniNetwork(nn.Module):
    """Encoder, passes, decoder; what is left of each potential flow starts as two learned numbers."""

    def __init__(self, options: LiquidPsiIniOptions):
        super().__init__()
        o = options
        self.left = nn.Parameter(torch.zeros(BASIS).index_fill(0, torch.tensor([LONG]), 0.8))
        self.processor = Processor(NODE_FEATURES, EDGE_FEATURES, o.width, o.hidden_layers, o.passes, False, False)
        self.decoder = Perceptron(o.width, o.width, BASIS + 1, o.hidden_layers, gain=0.3)

    def forward(self, inputs: LiquidInputs) -> tuple[Float[torch.Tensor, "nodes 3"], Float[torch.Tensor, "nodes 1"]]:
        """Velocity over `inputs.speed`, internal energy over `inputs.heat`."""
        decoded = self.decoder(self.processor(inputs.wiring, inputs.node, inputs.edge))
        shares = decoded[:, :BASIS] + self.left
        return (shares[:, :, None] * inputs.basis).sum(1), decoded[:, BASIS:]


class LiquidPsiIni:
    """A trained Psi_ini: `infer_fields` gives velocity and internal energy at the first frame."""

    def __init__(self, network: LiquidPsiIniNetwork, options: LiquidPsiIniOptions):
        self.network, self.options = network.eval(), options

    def infer_fields(
        self, body: Body, positions: Float[np.ndarray, "n 3"]
    ) -> dict[str, Float[np.ndarray, "n components"]]:
        """velocity [n, 3] m/s and internal_energy [n, 1] J/kg of a liquid at `positions` [m] after `body.motion`.

        Raises: OptionError where the body is no liquid in a vessel whose motion is known.
        """
        return self.at(inputs_of(body, positions))

    def at(self, inputs: LiquidInputs) -> dict[str, Float[np.ndarray, "n components"]]:
        """The same from features that are at hand."""
        with torch.no_grad():
            velocity, energy = self.network(inputs)
        return {
            "velocity": (velocity * inputs.speed).double().numpy(),
            "internal_energy": (energy * inputs.heat).double().numpy(),
        }

    @classmethod
    def load(cls, folder: str | Path) -> LiquidPsiIni:
        """The network that `train` wrote. Raises: DataError where a file is missing or does not fit."""
        card = card_of(folder)
        try:
            if card.pop("kind") != "liquid":
                raise ValueError("it is that of a solid")
            options = LiquidPsiIniOptions(**card)
            network = LiquidPsiIniNetwork(options)
            network.load_state_dict(torch.load(Path(folder) / "weights.pt", weights_only=True))
        except (OSError, KeyError, ValueError, TypeError, RuntimeError, OptionError) as error:
            raise DataError(f"The Psi_ini in {folder} is broken or missing ({error}); train it again.") from error
        return cls(network, options)


def load(folder: str | Path) -> LiquidPsiIni:
    """See `LiquidPsiIni.load`."""
    return LiquidPsiIni.load(folder)


@dataclass(frozen=True)
class Example:
    """A liquid at one frame: inputs, targets over their scales, weights [nodes, 1] that make errors relative."""

    inputs: LiquidInputs
    velocity: torch.Tensor
    energy: torch.Tensor
    velocity_weight: torch.Tensor
    energy_weight: torch.Tensor


def example_of(trajectory: Trajectory, frame: int) -> Example:
    """Frame `frame` of a trajectory as the first one of a motion that ended so much earlier."""
    body, fields = trajectory.body, trajectory.at(frame)
    inputs = inputs_of(body, fields["position"], float(trajectory.times[frame] - trajectory.times[0]))
    speed, heat = max(float(inputs.speed[0]), NO_ENERGY), max(float(inputs.heat[0]), NO_ENERGY)
    velocity = torch.tensor(fields["velocity"] / speed, dtype=torch.float32)
    energy = torch.tensor(fields["internal_energy"] / heat, dtype=torch.float32)

    def weight(target: torch.Tensor) -> torch.Tensor:
        return torch.full((len(target), 1), 1.0 / (float(target.square().sum()) + LEAST**2 * len(target)))

    return Example(inputs, velocity, energy, weight(velocity), weight(energy))


def train(
    dataset_folder: str | Path, options: LiquidPsiIniOptions, out: str | Path, scratch: str | Path
) -> dict[str, Any]:
    """Trains Psi_ini on the train liquids and writes `psi_ini.json`, `weights.pt` and `training.csv` into `out`.

    The state of the training is kept in `scratch`, so that a killed run goes on. Returns per split the figures of
    `errors_of` at the first frames.

    Raises: DataError where the data set has no train trajectories of liquids.
    """
    data, began = Dataset(dataset_folder), time.perf_counter()
    torch.set_num_threads(1)
    entries = data.split("train")
    if not entries:
        raise DataError(f"{dataset_folder} has no train trajectories; make the data set with a train split.")
    examples = _Examples(data, entries, options)
    watched = examples_of(data, data.split("val") or entries[:4])
    torch.manual_seed(options.seed)
    network = LiquidPsiIniNetwork(options)
    psi_ini = LiquidPsiIni(network, options)

    def judge() -> float:
        figures = errors_of(psi_ini, watched)
        return figures["velocity_rrmse"] + 0.5 * figures["internal_energy_rrmse"]

    rows = optimise(
        network,
        lambda step: _loss(network, examples, np.random.default_rng([options.seed, step])),
        judge,
        steps=options.steps,
        learning_rate=options.learning_rate,
        check_every=options.check_every,
        scratch=Path(scratch),
    )
    psi_ini.network.eval()
    keep(Path(out), network, {"kind": "liquid", **asdict(options)}, rows)
    splits = {
        s: errors_of(psi_ini, examples_of(data, data.split(s))) for s in ("val", "test", "beyond") if data.split(s)
    }
    return {"seconds": time.perf_counter() - began, "bodies": len(entries), **splits}


class _Examples:
    """Examples of the train liquids, made when they are first asked for."""

    def __init__(self, data: Dataset, entries: list[DatasetEntry], options: LiquidPsiIniOptions):
        self.data, self.entries, self.options = data, entries, options
        self.kept: dict[tuple[int, int], Example] = {}

    def draw(self, rng: np.random.Generator) -> Example:
        """A random frame of a random liquid; the first one more often than the others."""
        number, frames = int(rng.integers(len(self.entries))), self.options.frames
        first = rng.random() < self.options.first_share
        frame = frames[0] if first else frames[int(rng.integers(len(frames)))]
        if (number, frame) not in self.kept:
            trajectory = self.data.read(self.entries[number])
            for each in frames:  # the file is read once
                self.kept[number, each] = example_of(trajectory, min(each, trajectory.frames - 1))
        return self.kept[number, frame]


def _loss(network: LiquidPsiIniNetwork, examples: _Examples, rng: np.random.Generator) -> torch.Tensor:
    """Mean squared relative error of velocity, and half of that of internal energy, of some random examples."""
    batch = [examples.draw(rng) for _ in range(examples.options.batch)]
    velocity, energy = network(merge_inputs([e.inputs for e in batch]))
    first = (velocity - torch.cat([e.velocity for e in batch])).square() * torch.cat([e.velocity_weight for e in batch])
    second = (energy - torch.cat([e.energy for e in batch])).square() * torch.cat([e.energy_weight for e in batch])
    return (first.sum() + 0.5 * second.sum()) / len(batch)


def examples_of(data: Dataset, entries: list[DatasetEntry]) -> list[tuple[Trajectory, LiquidInputs]]:
    """First frames with their features."""
    read = [data.read(e) for e in entries]
    return [(t, inputs_of(t.body, t.fields["position"][0])) for t in read]


def errors_of(psi_ini: LiquidPsiIni, examples: list[tuple[Trajectory, LiquidInputs]]) -> dict[str, float]:
    """Errors at first frames: RRMSE (mean and worst over liquids) of velocity and internal energy, RMSE of each.

    velocity_rmse_x, _y (horizontal), _z (vertical) [m/s] and internal_energy_rmse [J/kg] are over all particles of all
    liquids, as the seed's 0.027, 0.034 and 0.083 m/s are; velocity_rms [m/s, per component] is the error of the guess
    that nothing moves (whose RRMSE is 1). velocity_rrmse_constant: RRMSE of the guess that all particles of all liquids
    move with the best multiple of their vessel's fastest velocity.
    """
    ours, true, guess, energies = [], [], [], []
    for trajectory, inputs in examples:
        found = psi_ini.at(inputs)
        ours.append(found["velocity"])
        true.append(trajectory.fields["velocity"][0])
        energies.append((found["internal_energy"], trajectory.fields["internal_energy"][0]))
        assert trajectory.body.motion is not None  # inputs_of has checked it
        moved = trajectory.body.motion.velocity
        guess.append(np.broadcast_to(moved[int(np.argmax((moved**2).sum(1)))], true[-1].shape))
    share = sum(float((g * t).sum()) for g, t in zip(guess, true, strict=True))
    share /= max(sum(float((g * g).sum()) for g in guess), 1e-12)

    def relative(pairs: list[tuple[np.ndarray, np.ndarray]]) -> list[float]:
        return [float(np.sqrt(((a - b) ** 2).sum() / max((b**2).sum(), 1e-30))) for a, b in pairs]

    velocity, energy = relative(list(zip(ours, true, strict=True))), relative(energies)
    gap = np.concatenate(ours) - np.concatenate(true)
    rmse = np.sqrt((gap**2).mean(0))
    heat = np.concatenate([a - b for a, b in energies])
    return {
        "velocity_rrmse": float(np.mean(velocity)),
        "velocity_rrmse_worst": float(np.max(velocity)),
        "velocity_rmse_x": float(rmse[0]),
        "velocity_rmse_y": float(rmse[1]),
        "velocity_rmse_z": float(rmse[2]),
        "internal_energy_rrmse": float(np.mean(energy)),
        "internal_energy_rrmse_worst": float(np.max(energy)),
        "internal_energy_rmse": float(np.sqrt((heat**2).mean())),
        "velocity_rms": float(np.sqrt((np.concatenate(true) ** 2).mean())),
        "velocity_rrmse_constant": float(np.mean(relative([(share * g, t) for g, t in zip(guess, true, strict=True)]))),
        "bodies": float(len(examples)),
    }
