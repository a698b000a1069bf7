"""Cross-section symmetries as augmentation: reflections of y and z and the exchange of both (quarter turns).

The material is isotropic, so a turned or mirrored body under turned loads moves like its image. The transform acts
on vectors and tensors, on the reference edge vectors among them, and leaves the numbering alone: a beam of 10 x 20 cm
becomes one of 20 x 10 cm. The clamp stays where it is because x is kept.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from zsdt.tignn.features import GraphBatch, NodeState

_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def section_symmetries() -> Float[np.ndarray, "8 3 3"]:
    """The eight orthogonal maps of the cross-section that keep x: signs of y and z, with and without exchange."""
    found = []
    for swap, y, z in itertools.product((False, True), (1.0, -1.0), (1.0, -1.0)):
        order = [0, 2, 1] if swap else [0, 1, 2]
        found.append(np.diag([1.0, y, z]) @ np.eye(3)[order])
    return np.array(found)


def stress_map(turn: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "6 6"]:
    """Matrix that maps 11 22 33 12 13 23 of a symmetric tensor s to those of R s R'."""
    columns = []
    for a, b in _PAIRS:
        unit = np.zeros((3, 3))
        unit[a, b] = unit[b, a] = 1.0
        turned = turn @ unit @ turn.T
        columns.append([turned[i, j] for i, j in _PAIRS])
    return np.array(columns).T


def turn_state(state: NodeState, turn: Float[np.ndarray, "3 3"]) -> NodeState:
    """The state of the turned body."""
    dtype = state.velocity.dtype
    vector = torch.as_tensor(turn.T.copy(), dtype=dtype)
    tensor = torch.as_tensor(stress_map(turn).T.copy(), dtype=dtype)
    rows = len(state.velocity)
    return NodeState(
        displacement=state.displacement @ vector,
        velocity=state.velocity @ vector,
        stress=state.stress @ tensor,
        increments=(state.increments.view(rows, -1, 3) @ vector).reshape(rows, -1),
        thermal=state.thermal,
    )


def turn_batch(batch: GraphBatch, turn: Float[np.ndarray, "3 3"]) -> GraphBatch:
    """The turned body: its reference edge vectors and gravity."""
    vector = torch.as_tensor(turn.T.copy(), dtype=batch.arm.dtype)
    return replace(batch, arm=batch.arm @ vector, gravity=batch.gravity @ vector)


def turn_load(load: Float[torch.Tensor, "*rows 3"], turn: Float[np.ndarray, "3 3"]) -> Float[torch.Tensor, "*rows 3"]:
    """The load on the turned body."""
    return load @ torch.as_tensor(turn.T.copy(), dtype=load.dtype)
