"""Psi_ini of a solid: deformed node positions of a body at rest -> Cauchy stress at its nodes (DESIGN 4.3; seed, IV.B).

A static encoder-processor-decoder. At rest stress is a local function of strain, so a few passes are enough and no
size is special. Features are made of lengths and angles alone (Green's strain of the node's neighbourhood, how far
each edge departs from it, gravity seen from the material) and divided by one strain per body, so a turned body, a
softer one, or one under another gravity stays in the range of training.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from zsdt.errors import DataError, OptionError
from zsdt.fields import von_mises
from zsdt.tignn.equilibria import Rest, first_frames, sample_equilibria, turned
from zsdt.tignn.features import GraphBatch, body_batch, merge
from zsdt.tignn.message_passing import Perceptron, Processor
from zsdt.tignn.psi_ini_training import card_of, keep, optimise
from zsdt.trajectory import Body, Dataset

if TYPE_CHECKING:
    from zsdt.tignn.psi_ini_liquid import LiquidPsiIni

NODE_FEATURES, EDGE_FEATURES = 17, 7
_I, _J = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])


@dataclass
class PsiIniOptions:
    """Network and training of Psi_ini.

    passes, width, hidden_layers: of the processor. steps, batch, learning_rate: of the training. extra: static
    equilibria that are computed beside the first frames of the data set (random train sizes, stiffness, gravity and
    held loads). check_every: steps between looks at the val beams, whose best weights are kept.
    """

    passes: int = 3
    width: int = 48
    hidden_layers: int = 1
    steps: int = 4000
    batch: int = 6
    learning_rate: float = 2e-3
    extra: int = 120
    check_every: int = 250
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.passes, self.width, self.hidden_layers, self.steps, self.batch, self.check_every) < 1:
            raise OptionError("passes, width, hidden_layers, steps, batch and check_every of psi_ini must be positive.")
        if self.extra < 0:
            raise OptionError(f"extra = {self.extra} must not be negative.")


@dataclass(frozen=True)
class Inputs:
    """A body at rest as the network sees it; deformation [nodes, 3, 3]: F of each node; unit [nodes, 1] Pa."""

    batch: GraphBatch
    node: torch.Tensor
    edge: torch.Tensor
    strain: torch.Tensor
    deformation: torch.Tensor
    unit: torch.Tensor


def inputs_of(body: Body, positions: Float[np.ndarray, "nodes 3"]) -> Inputs:
    """Features of a body with a known material at `positions` [m].

    Raises: OptionError where the body has no material, or nodes without neighbours in every direction.
    """
    if body.material is None:
        raise OptionError("Psi_ini needs the body's material to scale its stress; this data set does not say it.")
    batch = body_batch(body)
    to, source, arm = batch.to.numpy(), batch.source.numpy(), batch.arm.numpy().astype(np.float64)
    reach = (positions[source] - positions[to]) / body.pitch
    square, mixed = np.zeros((body.nodes, 3, 3)), np.zeros((body.nodes, 3, 3))
    np.add.at(square, to, arm[:, :, None] * arm[:, None, :])
    np.add.at(mixed, to, reach[:, :, None] * arm[:, None, :])
    if np.linalg.det(square).min() < 1e-6:
        raise OptionError("Psi_ini needs neighbours in all three directions at every node; check the graph.")
    deformation = mixed @ np.linalg.inv(square)
    green = 0.5 * (deformation.transpose(0, 2, 1) @ deformation - np.eye(3))
    departure = np.einsum("eki,ek->ei", deformation[to], reach - np.einsum("eij,ej->ei", deformation[to], arm))
    stretch = 0.5 * ((reach**2).sum(1) - (arm**2).sum(1))
    size = max(float(np.sqrt((green**2).sum((1, 2)).mean())), 1e-6)
    young, density = body.material.young, body.material.density
    pull = np.einsum("nki,k->ni", deformation, body.gravity) * density * body.pitch / (young * size)
    sides = np.zeros((body.nodes, 6))
    for axis in range(3):
        for k, sign in enumerate((-1, 1)):
            sides[to[sign * arm[:, axis] > 0.5], 2 * axis + k] = 1.0
    ones = np.ones((body.nodes, 1))
    strain = green[:, _I, _J] / size
    node = np.concatenate([strain, pull, sides, body.clamped[:, None] * 1.0, np.log10(size) * ones], axis=1)
    edge = np.concatenate([arm, 3 * departure / size, stretch[:, None] / size], axis=1)
    tensor = torch.tensor
    return Inputs(
        batch=batch,
        node=tensor(node, dtype=torch.float32),
        edge=tensor(edge, dtype=torch.float32),
        strain=tensor(strain, dtype=torch.float32),
        deformation=tensor(deformation, dtype=torch.float32),
        unit=tensor(young * size * ones, dtype=torch.float32),
    )


def merge_inputs(parts: list[Inputs]) -> Inputs:
    """Several bodies side by side."""
    joined = {n: torch.cat([getattr(p, n) for p in parts]) for n in ("node", "edge", "strain", "deformation", "unit")}
    return Inputs(batch=merge([p.batch for p in parts]), **joined)


class PsiIniNetwork(nn.Module):
    """Encoder, passes, decoder; Hooke's law of the node's own strain with two learned moduli, plus a correction."""

    def __init__(self, options: PsiIniOptions):
        super().__init__()
        o = options
        self.moduli = nn.Parameter(torch.tensor([0.4, 0.4]))
        self.processor = Processor(NODE_FEATURES, EDGE_FEATURES, o.width, o.hidden_layers, o.passes, False, False)
        self.decoder = Perceptron(o.width, o.width, 6, o.hidden_layers, gain=0.1)

    def forward(self, inputs: Inputs) -> Float[torch.Tensor, "nodes 6"]:
        """Cauchy stress over `unit` of each node, order 11 22 33 12 13 23."""
        trace = inputs.strain[:, :3].sum(1, keepdim=True)
        hooke = 2 * self.moduli[0] * inputs.strain
        hooke = torch.cat([hooke[:, :3] + self.moduli[1] * trace, hooke[:, 3:]], dim=1)
        second = hooke + self.decoder(self.processor(inputs.batch, inputs.node, inputs.edge))
        tensor = second.new_empty(second.shape[0], 3, 3)
        tensor[:, _I, _J] = second
        tensor[:, _J, _I] = second
        f = inputs.deformation
        cauchy = f @ tensor @ f.transpose(1, 2) / torch.linalg.det(f)[:, None, None]
        return cauchy[:, _I, _J]


class PsiIni:
    """A trained Psi_ini: `infer` gives the stress at rest."""

    def __init__(self, network: PsiIniNetwork, options: PsiIniOptions):
        self.network, self.options = network.eval(), options

    def infer(self, body: Body, positions: Float[np.ndarray, "nodes 3"]) -> Float[np.ndarray, "nodes 6"]:
        """Cauchy stress [Pa] at the nodes of a body at rest, order 11 22 33 12 13 23, from node positions [m]."""
        inputs = inputs_of(body, positions)
        with torch.no_grad():
            return (self.network(inputs) * inputs.unit).double().numpy()

    def infer_fields(
        self, body: Body, positions: Float[np.ndarray, "nodes 3"]
    ) -> dict[str, Float[np.ndarray, "nodes 6"]]:
        """The fields that no camera sees by their names: stress (see `infer`)."""
        return {"stress": self.infer(body, positions)}

    @classmethod
    def load(cls, folder: str | Path) -> PsiIni:
        """The network that `train` wrote. Raises: DataError where a file is missing or does not fit."""
        card = card_of(folder)
        try:
            if card.pop("kind") != "solid":
                raise ValueError("it is that of a liquid")
            options = PsiIniOptions(**card)
            network = PsiIniNetwork(options)
            network.load_state_dict(torch.load(Path(folder) / "weights.pt", weights_only=True))
        except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
            raise DataError(f"The Psi_ini in {folder} is broken or missing ({error}); train it again.") from error
        return cls(network, options)


def load(folder: str | Path) -> PsiIni | LiquidPsiIni:
    """The Psi_ini in `folder`, of a solid or of a liquid: both have `infer_fields(body, positions)`.

    Raises: DataError where it is missing, broken, or of an unknown kind.
    """
    kind = card_of(folder)["kind"]
    if kind not in ("solid", "liquid"):
        raise DataError(f"The Psi_ini in {folder} is of the kind '{kind}', known are solid and liquid.")
    if kind == "solid":
        return PsiIni.load(folder)
    from zsdt.tignn.psi_ini_liquid import LiquidPsiIni  # no twin of a beam needs it

    return LiquidPsiIni.load(folder)


def train(dataset_folder: str | Path, options: PsiIniOptions, out: str | Path, scratch: str | Path) -> dict[str, Any]:
    """Trains Psi_ini on the train beams and writes `psi_ini.json`, `weights.pt` and `training.csv` into `out`.

    Extra equilibria and the state of the training are kept in `scratch`, so that a killed run goes on. Returns per
    split: mean and worst RRMSE of the axial component, RMSE [Pa] of the axial component and of von Mises, over the
    free nodes of the first frames.

    Raises: DataError where the data set has no train beams.
    """
    data = Dataset(dataset_folder)
    began = time.perf_counter()
    torch.set_num_threads(1)
    bodies = first_frames(data, "train")
    if not bodies:
        raise DataError(f"{dataset_folder} has no train trajectories; make the data set with a train split.")
    bodies += sample_equilibria([r.body for r in bodies], options.extra, options.seed, Path(scratch))
    watched = first_frames(data, "val") or bodies[:4]
    torch.manual_seed(options.seed)
    network = PsiIniNetwork(options)
    psi_ini, images = PsiIni(network, options), _Images(bodies)
    rows = optimise(
        network,
        lambda step: _loss(network, images, options.batch, np.random.default_rng([options.seed, step])),
        lambda: errors_of(psi_ini, watched)["axial_rrmse"],
        steps=options.steps,
        learning_rate=options.learning_rate,
        check_every=options.check_every,
        scratch=Path(scratch),
    )
    network.eval()
    keep(Path(out), network, {"kind": "solid", **asdict(options)}, rows)
    splits = {s: errors_of(psi_ini, first_frames(data, s)) for s in ("val", "test", "beyond") if data.split(s)}
    return {"seconds": time.perf_counter() - began, "bodies": len(bodies), **splits}


class _Images:
    """Features and targets of the mirror images of the bodies, made when they are first asked for."""

    def __init__(self, bodies: list[Rest]):
        self.bodies = bodies
        self.kept: dict[tuple[int, int], tuple[Inputs, torch.Tensor, torch.Tensor]] = {}

    def __call__(self, number: int, image: int) -> tuple[Inputs, torch.Tensor, torch.Tensor]:
        """Inputs, target over unit [nodes, 6], weight [nodes] (zero at the clamp; one relative error a body)."""
        if (number, image) not in self.kept:
            rest = turned(self.bodies[number], image)
            inputs, free = inputs_of(rest.body, rest.position), ~rest.body.clamped
            unit = float(inputs.unit[0])
            weight = free * unit**2 / max(float((rest.stress[free] ** 2).sum()), 1e-12)
            target = torch.tensor(rest.stress / unit, dtype=torch.float32)
            self.kept[number, image] = (inputs, target, torch.tensor(weight, dtype=torch.float32))
        return self.kept[number, image]


def _loss(network: PsiIniNetwork, images: _Images, batch: int, rng: np.random.Generator) -> torch.Tensor:
    """Mean squared relative error of the stress of some random bodies, each mirrored or turned about its axis."""
    numbers = rng.integers(len(images.bodies), size=batch)
    inputs, targets, weights = zip(*(images(int(k), int(rng.integers(8))) for k in numbers), strict=True)
    gap = network(merge_inputs(list(inputs))) - torch.cat(targets)
    return (gap.square().sum(1) * torch.cat(weights)).sum() / batch


def errors_of(psi_ini: PsiIni, bodies: list[Rest]) -> dict[str, float]:
    """Errors over the free nodes of bodies at rest: mean and worst axial RRMSE, RMSE [Pa] of axial and von Mises."""
    axial, worst_of, whole, mises = [], [], [], []
    for rest in bodies:
        free = ~rest.body.clamped
        ours, true = psi_ini.infer(rest.body, rest.position)[free], rest.stress[free]
        axial.append(float(np.sqrt(((ours - true)[:, 0] ** 2).mean())))
        worst_of.append(axial[-1] / max(float(np.sqrt((true[:, 0] ** 2).mean())), 1e-12))
        whole.append(float(np.sqrt(((ours - true) ** 2).sum() / max((true**2).sum(), 1e-12))))
        mises.append(float(np.sqrt(((von_mises(ours) - von_mises(true)) ** 2).mean())))
    return {
        "axial_rrmse": float(np.mean(worst_of)),
        "axial_rrmse_worst": float(np.max(worst_of)),
        "stress_rrmse": float(np.mean(whole)),
        "axial_rmse": float(np.mean(axial)),
        "von_mises_rmse": float(np.mean(mises)),
        "bodies": float(len(bodies)),
    }
