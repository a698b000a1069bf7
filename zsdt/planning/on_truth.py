"""A beam's twin on another grid than the truth's, held against the truth at all of the truth's nodes, and the truth on
the twin's grid.

Between its nodes a graph of bricks says what is linear between them. A graph of one layer says the same all over the
width of the beam.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

from zsdt.errors import DataError
from zsdt.evaluation.metrics import field_errors
from zsdt.trajectory import Body, Trajectory
from zsdt.twin.twin_view import TwinView

OUTSIDE = 1e-6  # of the pitch, by which a point may lie outside of the grid


def between_nodes(
    body: Body, points: Float[np.ndarray, "points 3"], any_width: bool = False
) -> sp.csr_matrix:  # [points, nodes]
    """Weights [points, nodes] of the nodes of a body of bricks in what it says at `points` [m], linear along each axis.

    any_width: y does not count; the values are those of the layer y = 0, as all layers of a graph of one layer are
    taken for one.

    Raises: DataError where a point lies outside of the body.
    """
    low = body.points.min(axis=0)
    place = np.rint((body.points - low) / body.pitch).astype(np.int64)
    count = place.max(axis=0) + 1
    number = np.full(count, -1, np.int64)
    number[tuple(place.T)] = np.arange(body.nodes)
    at = (points - low) / body.pitch
    if any_width:
        at[:, 1] = 0.0
    if len(at) and ((at < -OUTSIDE).any() or (at > count - 1 + OUTSIDE).any()):
        raise DataError("The truth reaches beyond the twin's body; compare a run with the truth of its own clip.")
    cell = np.clip(np.floor(at + OUTSIDE).astype(np.int64), 0, np.maximum(count - 2, 0))
    share = np.clip(at - cell, 0.0, 1.0)
    matrix = sp.csr_matrix((len(points), body.nodes))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(np.array(corner), share, 1.0 - share), axis=1)
        used = np.flatnonzero(weight > 1e-12)
        nodes = number[tuple((cell[used] + corner).T)]
        matrix = matrix + sp.csr_matrix((weight[used], (used, nodes)), matrix.shape)
    return sp.csr_matrix(matrix)


def errors_on_truth(view: TwinView, truth: Trajectory, one_layer: bool = False) -> dict[str, float]:
    """RRMSE [-] of position (as displacement), velocity, stress and von_mises over all frames but the first and all
    free nodes of the truth, hidden ones included."""
    weights = between_nodes(view.body, truth.body.points, one_layer)
    fields = {name: _at(weights, values) for name, values in view.fields.items()}
    position = truth.body.points + _at(weights, view.positions - view.body.points)
    theirs = {name: values[view.frames] for name, values in truth.fields.items()}
    found = field_errors({"position": position, **fields}, theirs, ~truth.body.clamped)
    figures = {"position": found["displacement_rrmse"]}
    return figures | {n: found[f"{n}_rrmse"] for n in ("velocity", "stress", "von_mises") if f"{n}_rrmse" in found}


def truth_at(body: Body, truth: Trajectory, far_side: bool = False) -> Trajectory:
    """The truth at the nodes of a twin's body, to be drawn beside it. far_side: the camera sees the side of high y,
    where a graph of one layer lies."""
    points = body.points.copy()
    if far_side:
        points[:, 1] += float(np.ptp(truth.body.points[:, 1])) - float(np.ptp(points[:, 1]))
    weights = between_nodes(truth.body, points)
    moved = _at(weights, truth.fields["position"] - truth.body.points)
    fields = {name: _at(weights, values) for name, values in truth.fields.items()}
    load = np.zeros((truth.frames, body.nodes, 3))
    return replace(truth, body=body, fields=fields | {"position": body.points + moved}, load=load)


def _at(weights: sp.csr_matrix, values: Float[np.ndarray, "frames nodes n"]) -> Float[np.ndarray, "frames points n"]:
    """Values at the points in every frame."""
    frames, nodes, n = values.shape
    flat = np.ascontiguousarray(values.transpose(1, 0, 2)).reshape(nodes, frames * n)
    return np.asarray(weights @ flat).reshape(-1, frames, n).transpose(1, 0, 2)
