"""Choices of the learned engine and of its training. Defaults live here and nowhere else."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from zsdt.errors import OptionError
from zsdt.tignn.cell_energy import CellOptions
from zsdt.tignn.particle_options import ParticleOptions


class Form(Enum):
    """node: the seed's form, several passes and one step a frame. cell: many small local steps with a cell energy.
    particle: the same for liquids, with exchange between particles. seed: the seed's network to the letter, to compare
    with."""

    node = "node"
    cell = "cell"
    particle = "particle"
    seed = "seed"


class Bracket(Enum):
    """soft: decoded matrices and a penalty (seed, Eq. 3). exact: projected two-node brackets. none: plain decoder."""

    soft = "soft"
    exact = "exact"
    none = "none"


class Energy(Enum):
    """learned: decoded gradients (seed). physical: closed-form gradient of the total energy of the state."""

    learned = "learned"
    physical = "physical"


class NoiseKind(Enum):
    """additive: Gaussian, with the target corrected. multiplicative: the state times 1 + noise (seed)."""

    additive = "additive"
    multiplicative = "multiplicative"


class GraphScale(Enum):
    """Magnitude by which features and increments of one graph are divided: none, of its load, or of its motion."""

    none = "none"
    load = "load"
    motion = "motion"


class Walls(Enum):
    """features: signed distance and normal at every particle. nodes: points of the wall join the graph (seed)."""

    features = "features"
    nodes = "nodes"


@dataclass
class LiquidOptions:
    """What form=node needs for a liquid; lengths in particle spacings.

    walls: how the network sees the vessel. cutoff: radius of the graph. skin: how much farther its list reaches, so
    that calm frames can keep it. clamp: least distance from the wall that a particle is held at. relaxation: sweeps
    per frame against clustering, at inference. energy_weight: of the error of the internal energy beside that of the
    velocity.
    """

    walls: Walls = Walls.features
    cutoff: float = 1.8
    skin: float = 0.3
    clamp: float = 0.1
    relaxation: int = 0
    energy_weight: float = 0.2

    def __post_init__(self) -> None:
        if not 1.0 < self.cutoff <= 4.0 or self.skin < 0:
            raise OptionError("The cutoff of a liquid's graph must lie in (1, 4] spacings, its skin be at least 0.")
        if not 0.0 <= self.clamp < 0.5 or self.relaxation < 0 or self.energy_weight < 0:
            raise OptionError("clamp must lie in [0, 0.5), relaxation and energy_weight must not be negative.")


@dataclass
class TignnOptions:
    """The graph network.

    passes: message passes of a step. local_passes: passes of the second half of a staggered step. width and
    hidden_layers: of every multi-layer perceptron. rank: brackets per edge (exact). lambda_d: weight of the data
    term beside the degeneracy penalty (soft). global_context: a virtual node per graph. staggered: velocity first,
    then stress from the new velocity and configuration. split_pressure: pressure and deviator on scales of their
    own. stress_memory: share of the old stress that
    the new one starts from (1: the network adds an increment, 0: it reads the stress anew). stress_input: the
    stress is a node feature. symmetric: predictions are the mean over the eight symmetries of the cross-section, so
    that they commute with them exactly, at eight times the cost. history: how many recent velocity increments are
    node features. liquid: options of form=node for liquids, which read form, bracket, energy, passes, width,
    hidden_layers, shared_weights, rank, lambda_d, global_context besides. cell: options of form=cell, particle: of
    form=particle, which read nothing else here. form=seed reads passes, width, hidden_layers, shared_weights, lambda_d
    and liquid.
    """

    form: Form = Form.node
    bracket: Bracket = Bracket.exact
    energy: Energy = Energy.learned
    passes: int = 8
    local_passes: int = 4
    width: int = 64
    hidden_layers: int = 1
    shared_weights: bool = False
    rank: int = 2
    lambda_d: float = 50.0
    global_context: bool = True
    staggered: bool = True
    graph_scale: GraphScale = GraphScale.none
    split_pressure: bool = True
    stress_memory: float = 1.0
    stress_input: bool = False
    symmetric: bool = False
    history: int = 0
    liquid: LiquidOptions = field(default_factory=LiquidOptions)
    cell: CellOptions = field(default_factory=CellOptions)
    particle: ParticleOptions = field(default_factory=ParticleOptions)

    def __post_init__(self) -> None:
        if self.passes < 1 or self.local_passes < 1 or self.width < 1 or self.hidden_layers < 1 or self.rank < 1:
            raise OptionError("passes, local_passes, width, hidden_layers and rank must be at least 1.")
        if self.lambda_d <= 0:
            raise OptionError(f"lambda_d = {self.lambda_d} must be positive; the seed uses 50.")
        if self.history < 0:
            raise OptionError(f"history = {self.history} must not be negative.")
        if self.energy is Energy.physical and self.bracket is not Bracket.exact:
            raise OptionError("energy=physical needs bracket=exact.")


@dataclass
class TrainingOptions:
    """How the network is trained.

    steps: optimiser steps. batch: graphs a step. noise: standard deviation on the velocity relative to the scale of
    the velocity; stress_noise: the same on the stress. unroll: longest push-forward (steps without gradient before
    the one that is learned), used after the fraction unroll_from of the steps. augment: cross-section symmetries.
    relative_loss: every trajectory is weighed by its own magnitude. holdout: training trajectories kept
    aside to choose the checkpoint by rollout (by name, or the last `holdout_count`). check_every: steps between
    such rollouts; patience: checks without gain before it stops early (0: never). ema: averaging of the weights.
    devices: processes that share the graphs of a step, on one core each (at most `batch`; node form only); the loss
    curve is that of one process but for the order in which floats are added.
    Of liquids positions get noise as well (half a spacing per unit); stress_noise and augment are not read.
    """

    steps: int = 20000
    batch: int = 2
    learning_rate: float = 1.5e-3
    warmup: float = 0.02
    weight_decay: float = 1e-6
    noise: float = 2e-3
    stress_noise: float = 0.0
    noise_kind: NoiseKind = NoiseKind.additive
    unroll: int = 4
    unroll_from: float = 0.5
    augment: bool = True
    relative_loss: bool = True
    ema: float = 0.999
    holdout: list[str] = field(default_factory=list)
    holdout_count: int = 2
    check_every: int = 1000
    patience: int = 0
    checkpoint_every: int = 1000
    tensorboard: bool = False
    devices: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        if self.steps < 1 or self.batch < 1 or self.unroll < 1:
            raise OptionError("steps, batch and unroll must be at least 1.")
        if not 1 <= self.devices <= self.batch:
            raise OptionError(
                f"devices = {self.devices} must lie between 1 and batch = {self.batch}: each process learns from whole "
                "graphs."
            )
        if self.noise < 0 or self.stress_noise < 0:
            raise OptionError("noise and stress_noise must not be negative.")
        if not 0.0 <= self.ema < 1.0:
            raise OptionError(f"ema = {self.ema} must lie in [0, 1).")
