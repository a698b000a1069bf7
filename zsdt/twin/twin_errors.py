"""How far a run of a twin is from the truth of the virtual lab, frame by frame."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from zsdt.errors import DataError
from zsdt.evaluation.metrics import errors_over_time
from zsdt.fields import von_mises
from zsdt.twin.twin_view import TwinView

# What a curve is called for people.
ERROR_NAMES = {"displacement": "displacement", "velocity": "velocity", "stress": "stress", "von_mises": "von Mises"}


def same_nodes(view: TwinView, truth: TwinView) -> Int[np.ndarray, " nodes"]:
    """For each node of the run its number in the truth, by where they are in the bodies without load.

    Raises: DataError where they are not on the same grid.
    """
    query: Any = cKDTree(truth.body.points).query(view.body.points)
    far, found = query
    if view.body.nodes != truth.body.nodes or far.max() > 0.1 * view.body.pitch or len(set(found)) < len(found):
        raise DataError(
            f"The run {view.name} ({view.body.nodes} nodes) and the truth ({truth.body.nodes} nodes) are not on the "
            "same grid; compare a run with the truth of its own clip."
        )
    return found


def relative_errors(view: TwinView, truth: TwinView) -> dict[str, Float[np.ndarray, " frames"]]:
    """Errors of each frame over the root mean square of the truth [-] (`errors_over_time`), free nodes only.

    displacement, velocity, stress and von_mises, as far as the run has decoded them.
    """
    there = same_nodes(view, truth)
    ours = {"position": view.positions, **view.fields}
    theirs = {"position": truth.positions[:, there], **{k: v[:, there] for k, v in truth.fields.items()}}
    if "von_mises" in ours and "stress" not in ours and "stress" in theirs:
        theirs["von_mises"] = von_mises(theirs["stress"])[..., None]
    curves = errors_over_time(ours, theirs, ~view.body.clamped)
    return {name: curves[name] for name in ERROR_NAMES if name in curves}


def distances(view: TwinView, truth: TwinView) -> Float[np.ndarray, "frames nodes"]:
    """Distance of every node of the run from its true place [m]."""
    return np.linalg.norm(view.positions - truth.positions[:, same_nodes(view, truth)], axis=2)


def tip_of(view: TwinView) -> Float[np.ndarray, " frames"]:
    """Height of the middle of the free end of the visible face [m]."""
    return view.on_front(view.positions)[:, -1, :, 2].mean(axis=1)
