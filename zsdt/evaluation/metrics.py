"""How far a rollout is from the truth: RMSE in SI, RRMSE, and both over the frames (DESIGN 6).

RRMSE of a field over a rollout is `sqrt(sum |predicted - true|^2 / sum |true|^2)` over all frames but the first, all
free nodes and all components; 1 means as wrong as predicting zero. A rollout that left the numbers (NaN) has an
infinite error. Values are fractions, not percent.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from zsdt.fields import von_mises

Series = Float[np.ndarray, "frames nodes *components"]


def rmse(predicted: Series, truth: Series) -> float:
    """Root mean square error over all frames, nodes and components, in the unit of the field."""
    return float(np.sqrt(_sum_of_squares(predicted - truth) / max(truth.size, 1)))


def rrmse(predicted: Series, truth: Series) -> float:
    """Relative root mean square error [-]; 0 for two zero fields, infinite for an error where the truth is zero."""
    error, size = _sum_of_squares(predicted - truth), _sum_of_squares(truth)
    if size == 0.0:
        return 0.0 if error == 0.0 else float("inf")
    return float(np.sqrt(error / size))


def _sum_of_squares(values: np.ndarray) -> float:
    total = float(np.sum(np.square(values)))
    return total if np.isfinite(total) else float("inf")


def derived_fields(
    fields: Mapping[str, Float[np.ndarray, "frames nodes _"]], first: Float[np.ndarray, "nodes 3"]
) -> dict[str, Float[np.ndarray, "frames nodes _"]]:
    """The fields together with those that are judged but not stored.

    displacement [m]: position less `first`, the first true positions (the plain RRMSE of positions flatters);
    von_mises [Pa], one component; axial_stress [Pa]: the 11 component; energy_increment [J/kg]: internal energy less
    that of the same side's first frame, so that it does not depend on what the energy is counted from.
    """
    extended = dict(fields)
    if "position" in fields:
        extended["displacement"] = fields["position"] - first
    if "stress" in fields:
        extended["von_mises"] = von_mises(fields["stress"])[..., None]
        extended["axial_stress"] = fields["stress"][..., :1]
    if "internal_energy" in fields:
        extended["energy_increment"] = fields["internal_energy"] - fields["internal_energy"][:1]
    return extended


def field_errors(
    predicted: Mapping[str, Float[np.ndarray, "frames nodes _"]],
    truth: Mapping[str, Float[np.ndarray, "frames nodes _"]],
    free: Bool[np.ndarray, " nodes"],
) -> dict[str, float]:
    """`<field>_rmse` (SI) and `<field>_rrmse` (fraction) of every field that both sides have, derived ones included.

    All frames but the first, free nodes only. Von Mises is compared as a scalar.
    """
    errors: dict[str, float] = {}
    for name, (ours, theirs) in _common(predicted, truth).items():
        ours, theirs = ours[1:, free], theirs[1:, free]
        errors[f"{name}_rmse"] = rmse(ours, theirs)
        errors[f"{name}_rrmse"] = rrmse(ours, theirs)
    return errors


def errors_over_time(
    predicted: Mapping[str, Float[np.ndarray, "frames nodes _"]],
    truth: Mapping[str, Float[np.ndarray, "frames nodes _"]],
    free: Bool[np.ndarray, " nodes"],
) -> dict[str, Float[np.ndarray, " frames"]]:
    """Error of every frame divided by the root mean square of the truth over the whole rollout (one denominator).

    So that the mean of the squares over all frames but the first is the square of the RRMSE of the rollout.
    """
    curves = {}
    for name, (ours, theirs) in _common(predicted, truth).items():
        ours, theirs = ours[:, free], theirs[:, free]
        per_frame = np.sqrt(np.mean((ours - theirs) ** 2, axis=(1, 2)))
        scale = np.sqrt(np.mean(theirs[1:] ** 2))
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = per_frame / scale if scale > 0 else np.where(per_frame > 0, np.inf, 0.0)
        curves[name] = np.where(np.isnan(relative), np.inf, relative)
    return curves


def error_growth(curve: Float[np.ndarray, " frames"]) -> float:
    """Mean error in the last quarter over that in the second quarter: 1 where it stays, 7/3 where it grows linearly.

    NaN for fewer than eight frames, where the word has no meaning, and where the second quarter is without error.
    """
    count = len(curve)
    if count < 8:
        return float("nan")
    early, late = curve[count // 4 : count // 2].mean(), curve[-(count // 4) :].mean()
    if early == 0.0:
        return float("nan")
    return float(late / early) if np.isfinite(late) else float("inf")


def mean_and_worst(values: list[float]) -> tuple[float, float]:
    """Mean and largest of the values of a set, without those that are undefined (NaN); NaN for an empty set."""
    defined = [v for v in values if not np.isnan(v)]
    if not defined:
        return float("nan"), float("nan")
    return float(np.mean(defined)), float(np.max(defined))


def _common(
    predicted: Mapping[str, np.ndarray], truth: Mapping[str, np.ndarray]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Pairs of fields that both sides have, derived ones included, cut to the shorter of the two."""
    frames = min(len(predicted["position"]), len(truth["position"]))
    first = truth["position"][0]
    ours = derived_fields({k: v[:frames] for k, v in predicted.items()}, first)
    theirs = derived_fields({k: v[:frames] for k, v in truth.items()}, first)
    return {name: (ours[name], theirs[name]) for name in ours if name in theirs}
