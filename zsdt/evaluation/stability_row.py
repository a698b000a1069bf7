"""What one party made of one hard case: bounded or rejected, its error over the frames, its energy account.

A row keeps curves; the table (`zsdt.evaluation.stability_table`) makes its figures of them, because how large a normal
error is follows from other rows.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path

import numpy as np
from jaxtyping import Float

from zsdt.errors import DataError
from zsdt.evaluation.ledger import closure, heat, total_energy, turnover, work_of_ports
from zsdt.files import atomic_path


class Party(StrEnum):
    """Who runs a case: the ground-truth solver, the network alone (open loop), the seed's soft form alone, the twin
    (closed loop)."""

    solver = "solver"
    network = "network"
    soft = "soft"
    twin = "twin"


class Outcome(StrEnum):
    """bounded: finite, and where bodies can be, to the end. rejected: given up with a reason. failed: anything else
    (not finite, out of range without a word, a hang, a crash)."""

    bounded = "bounded"
    rejected = "rejected"
    failed = "failed"


@dataclass
class Row:
    """One party in one case.

    frames: that were wanted; error [frames]: distance from the truth over a length of the body, NaN where unknown;
    hidden [frames]: the same of a field that nobody sees (stress over Young's modulus), none where it is not compared.
    energy_growth: largest |energy less start less work of the ports| over the largest turnover; entropy_min: smallest
    production in a frame over all that was produced (negative: the second law was broken). flags [frames]: of the trust
    monitor, None where nobody looked; gauges: what it measured, name -> [frames], or [1] of what does not change (see
    `zsdt.evaluation.stability_trust`). note: what else there is to say. seconds: that it took.
    """

    case: str
    kind: str
    party: str
    outcome: str
    reason: str = ""
    frames: int = 0
    error: list[float] = field(default_factory=list)
    energy_growth: float = math.nan
    entropy_min: float = math.nan
    flags: list[str] | None = None
    gauges: dict[str, list[float]] = field(default_factory=dict)
    hidden: list[float] = field(default_factory=list)
    note: str = ""
    seconds: float = 0.0


def books(account: dict[str, Float[np.ndarray, " frames"]], restarts: list[int] | None = None) -> tuple[float, float]:
    """(energy growth, least entropy production) of an account, as `Row` has them; NaN where it books nothing.

    restarts: frames at which a run began anew, where its books jump and nothing is judged.
    """
    known = {k: np.asarray(v, float) for k, v in account.items()}
    count = min((int(np.isfinite(v).sum()) for v in known.values()), default=0)
    if count < 2:
        return math.nan, math.nan
    known = {k: _without_jumps(v[:count], restarts or []) for k, v in known.items()}
    gap, hot = closure(known), heat(known)
    growth = math.nan if gap is None or total_energy(known) is None else float(np.abs(gap).max())
    if gap is not None and work_of_ports(known) is not None and turnover(known) == 0.0:
        growth = 0.0
    if hot is None:
        return growth, math.nan
    scale = float(np.abs(hot - hot[0]).max())
    return growth, float(np.diff(hot).min()) / scale if scale > 0 else 0.0


def _without_jumps(values: Float[np.ndarray, " frames"], restarts: list[int]) -> Float[np.ndarray, " frames"]:
    """The same curve without what happened between a frame of `restarts` and the one before."""
    steps = np.diff(values)
    steps[[k - 1 for k in restarts if 0 < k < len(values)]] = 0.0
    return values[0] + np.concatenate([[0.0], np.cumsum(steps)])


def write_row(path: Path, row: Row) -> None:
    """One JSON file; NaN as null."""
    card = asdict(row)
    for name in ("error", "hidden"):
        card[name] = _short(card[name])
    card["gauges"] = {name: _short(values) for name, values in row.gauges.items()}
    for name in ("energy_growth", "entropy_min"):
        card[name] = None if not math.isfinite(card[name]) else card[name]
    with atomic_path(path) as beside:
        beside.write_text(json.dumps(card))


def _short(values: list[float]) -> list[float | None]:
    return [None if not math.isfinite(x) else float(f"{x:.5g}") for x in values]


def _long(values: list[float | None]) -> list[float]:
    return [math.nan if x is None else float(x) for x in values]


def read_row(path: Path) -> Row:
    """What `write_row` wrote. Raises: DataError where it is broken."""
    try:
        card = json.loads(path.read_text())
        for name in ("error", "hidden"):
            card[name] = _long(card[name])
        card["gauges"] = {name: _long(values) for name, values in card["gauges"].items()}
        for name in ("energy_growth", "entropy_min"):
            card[name] = math.nan if card[name] is None else card[name]
        return Row(**card)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{path} is no row of the stability table ({error}); delete it and run the case again."
        ) from error
