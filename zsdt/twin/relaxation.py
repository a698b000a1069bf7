"""Newtonian relaxation (nudging) of the seed: observed nodes are pulled towards what is seen, any engine.

Nodes behind the visible face take the correction of the node in front of them, and velocity a share of it over the
frame time. It knows nothing of loads: under one that stays, the pull holds the beam up, and between two frames it
springs back. `ModeObserver` is the better half; this one is the method of the paper and works with the seed's own
form of the network.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int

from zsdt.errors import OptionError
from zsdt.trajectory import Body


def layer_spread(
    body: Body, front_nodes: Int[np.ndarray, "columns rows"], layer_weight: float
) -> Float[np.ndarray, "nodes points"] | sp.csr_matrix:
    """Matrix [nodes, points]: share of each visible node's correction that a node takes, `layer_weight` a layer.

    Raises: OptionError where a node has no visible node in front of it (a body that is no brick).
    """
    place = np.rint((body.points - body.points.min(axis=0)) / body.pitch).astype(np.int64)
    front = front_nodes.ravel()
    of = {(int(place[n, 0]), int(place[n, 2])): k for k, n in enumerate(front)}
    try:
        column = np.array([of[int(p[0]), int(p[2])] for p in place])
    except KeyError as error:
        raise OptionError("Relaxation needs a visible node in front of every node; use method=observer.") from error
    away = np.abs(place[:, 1] - place[front[0], 1])
    weight = np.where(body.clamped, 0.0, layer_weight ** away.astype(np.float64))
    return sp.csr_matrix((weight, (np.arange(body.nodes), column)), (body.nodes, len(front)))


def pull(
    slopes: Float[np.ndarray, "points numbers 3"], gap: Float[np.ndarray, "points numbers"]
) -> Float[np.ndarray, "points 3"]:
    """The shortest moves [m] of points that close the gap of what is measured."""
    square = slopes @ slopes.transpose(0, 2, 1)
    return np.einsum("pki,pk->pi", slopes, np.linalg.solve(square, gap[:, :, None])[:, :, 0])


def fill_unseen(
    values: Float[np.ndarray, "points 3"],
    seen: Bool[np.ndarray, " points"],
    front_nodes: Int[np.ndarray, "columns rows"],
) -> Float[np.ndarray, "points 3"]:
    """Values of unseen points from the nearest seen ones on the grid.

    Raises: OptionError where nothing is seen.
    """
    if not seen.any():
        raise OptionError("Nothing of the beam was seen in the first frame; begin with another one.")
    place = np.stack(np.meshgrid(*map(np.arange, front_nodes.shape), indexing="ij"), axis=-1).reshape(-1, 2)
    distance = ((place[:, None] - place[None, seen]) ** 2).sum(axis=2)
    return np.where(seen[:, None], values, values[seen][distance.argmin(axis=1)])
