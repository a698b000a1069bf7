"""Within which limits a run is trusted: the range of the training and of normal runs, kept beside the weights.

`trust.json` in the folder of an engine holds for every value of `trust_gauges`, `trust_audit` and `trust_innovation`
the range of the training data, that of normal runs, and the limits made of both: their hull, widened. An engine alone
has limits of its own, without what corrections do to a twin. `python -m pipelines.trust calibrate` writes the file.
Limits are never made of hard cases.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from zsdt.errors import DataError
from zsdt.files import atomic_path

log = logging.getLogger(__name__)

CARD = "trust.json"
PARTS = ("limits", "alone", "training", "normal_alone", "normal_twin")
Range = tuple[float, float]


class Flag(StrEnum):
    """Why a frame is not trusted.

    finite: a number of the state is none. card: size, material, pitch, frame time or gravity outside of the training.
    range: state or load outside of the training. energy: energy came from nowhere or went there. entropy: heat fell.
    innovation: what is seen does not scatter about the prediction as in normal runs. blind: what the observer does not
    know of the body has grown beyond that of normal runs. restarted: the twin gave up and began anew.
    """

    finite = "finite"
    card = "card"
    range = "range"
    energy = "energy"
    entropy = "entropy"
    innovation = "innovation"
    blind = "blind"
    restarted = "restarted"


@dataclass(frozen=True)
class Kind:
    """Of a value: the flag that it raises, and the number from which deviations are widened (None: by a factor).

    Values around a `centre` are widened by `margin` of their distance from it; on one side only where the centre is an
    end (0 for sizes of things). least: of the limits' distance from the centre, for what rounds to nothing.
    """

    flag: Flag
    centre: float | None = 0.0
    margin: float = 1.1
    least: float = 0.0


_STATE, _CARD = Kind(Flag.range), Kind(Flag.card, None)
_SEEN = Kind(Flag.innovation, margin=1.5)  # of few runs, with heavy tails
KINDS: dict[str, Kind] = {
    **dict.fromkeys(("stretch_low", "stretch_high", "nearest"), Kind(Flag.range, 1.0)),
    **dict.fromkeys(("rate", "speed", "stress", "load", "load_step", "load_peak", "load_found"), _STATE),
    **dict.fromkeys(("froude", "froude_mean", "top", "pressure_low", "pressure_high", "push"), _STATE),
    **dict.fromkeys(("length", "width", "depth", "slenderness", "pitch", "frame_dt", "gravity"), _CARD),
    **dict.fromkeys(("poisson", "g1", "demand"), _CARD),
    **dict.fromkeys(("young", "density", "tau", "viscosity"), Kind(Flag.card, None, 1.25)),  # told ones may be 20 % off
    **dict.fromkeys(("particles", "fill", "radius_widest", "radius_narrowest"), _CARD),
    **dict.fromkeys(("aspect", "corners"), _CARD),
    "tilt": Kind(Flag.card, least=0.01),
    **dict.fromkeys(("stiffness_found", "density_found", "viscosity_found"), Kind(Flag.card, None, 1.25)),
    **dict.fromkeys(("leak", "leak_total"), Kind(Flag.energy, margin=1.5, least=1e-6)),
    "guarded": Kind(Flag.energy, margin=1.5, least=0.5),
    "chill": Kind(Flag.entropy, least=1e-9),
    **dict.fromkeys(("variance", "bias", "lag", "scatter", "gap"), _SEEN),
    "believed": Kind(Flag.innovation, 1.0, least=0.1),
    "doubt": Kind(Flag.blind, margin=1.5),
}
# What only a high value of speaks against (a lower one is the better one), and what only a low one does.
HIGH = (
    "stretch_high", "rate", "speed", "stress", "load", "load_step", "load_peak", "load_found", "froude", "froude_mean",
    "top", "pressure_high", "push", "tilt", "demand", "leak", "leak_total", "guarded", "chill", "variance", "bias",
    "lag", "scatter", "gap", "doubt",
)  # fmt: skip
LOW = ("stretch_low", "nearest", "pressure_low", "believed")


def widened(name: str, low: float, high: float) -> Range:
    """Limits from the range of what is normal: one side is open where only the other speaks against a run."""
    kind = KINDS[name]
    if kind.centre is None:
        low, high = min(low / kind.margin, low * kind.margin), max(high * kind.margin, high / kind.margin)
    else:
        down = min((low - kind.centre) * kind.margin, -kind.least)
        low, high = kind.centre + down, kind.centre + max((high - kind.centre) * kind.margin, kind.least)
    return (-math.inf if name in HIGH else low, math.inf if name in LOW else high)


def scale_of(name: str, low: float, high: float) -> tuple[float, float, float]:
    """(middle, down, up) so that `(value - middle) * up` is 1 at the upper limit and `* down` 1 at the lower one; 0 on
    a side that is open. Sizes and materials have the middle of their limits."""
    centre = KINDS[name].centre
    middle = centre if centre is not None else 0.5 * (low + high)
    if not math.isfinite(middle):  # one end of a card is open: the other counts from zero
        middle = 0.0
    down = 1.0 / min(low - middle, -1e-12) if math.isfinite(low) else 0.0
    up = 1.0 / max(high - middle, 1e-12) if math.isfinite(high) else 0.0
    return middle, down, up


@dataclass
class TrustLimits:
    """limits: value -> (least, greatest) that is trusted of a twin; alone: of an engine that nobody corrects, which
    makes no jumps. training, normal_alone, normal_twin: the ranges that they come from; about: how they were made
    (command, data, runs)."""

    limits: dict[str, Range]
    alone: dict[str, Range] = field(default_factory=dict)
    training: dict[str, Range] = field(default_factory=dict)
    normal_alone: dict[str, Range] = field(default_factory=dict)
    normal_twin: dict[str, Range] = field(default_factory=dict)
    about: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        training: Mapping[str, Range],
        alone: Mapping[str, Range],
        twin: Mapping[str, Range] | None = None,
        about: Mapping[str, Any] | None = None,
    ) -> TrustLimits:
        """Limits around the training's range and that of normal runs of the engine alone, for a twin also its own.

        Sizes and materials of both kinds of runs count for both: corrections do not change them.
        """
        cards = {name: ends for name, ends in (twin or {}).items() if KINDS[name].flag is Flag.card}
        narrow, wide = hull((training, alone, cards)), hull((training, alone, twin or {}))
        return cls(_around(wide), _around(narrow), dict(training), dict(alone), dict(twin or {}), dict(about or {}))

    def within(self, alone: bool) -> dict[str, Range]:
        """The limits of an engine alone or of a twin."""
        return self.alone if alone and self.alone else self.limits

    def save(self, folder: Path) -> Path:
        """Writes `trust.json` beside the engine in `folder`. Raises: DataError where there is no engine."""
        card = {"engine": digest(folder), **vars(self)}
        with atomic_path(folder / CARD) as beside:
            beside.write_text(json.dumps(_plain(card), indent=1) + "\n")
        return folder / CARD


def _around(ranges: Mapping[str, Range]) -> dict[str, Range]:
    limits = {name: widened(name, *bounds) for name, bounds in ranges.items()}
    if limits.get("lag", (0.0, 0.0))[1] >= 1.0:  # unreachable: innovations of normal runs are not white
        del limits["lag"]
    return limits


# Without a card: physics alone. Twice the energy that ever moved is no error of a time step.
PHYSICS = TrustLimits({"leak_total": (-math.inf, 1.0), "chill": (-math.inf, 1e-6)})


def hull(ranges: Iterable[Mapping[str, Range]]) -> dict[str, Range]:
    """The smallest ranges that hold all of them."""
    found: dict[str, Range] = {}
    for part in ranges:
        for name, (low, high) in part.items():
            before = found.get(name, (low, high))
            found[name] = (min(before[0], low), max(before[1], high))
    return found


def digest(folder: Path) -> str:
    """What tells an engine from another: a hash of its card and weights. Raises: DataError where there is none."""
    card = folder / "engine.json"
    if not card.is_file():
        raise DataError(f"{folder} holds no trained engine (engine.json is missing); name the folder of one.")
    weights = folder / "weights.pt"
    return hashlib.sha256(card.read_bytes() + (weights.read_bytes() if weights.is_file() else b"")).hexdigest()[:16]


def load_limits(folder: str | Path | None) -> TrustLimits | None:
    """The limits beside an engine; None where there are none, or where they belong to other weights.

    Raises: DataError where the file is broken.
    """
    path = None if folder is None else Path(folder) / CARD
    if path is None or not path.is_file():
        return None
    try:
        card = json.loads(path.read_text())
        parts = {name: _ranges(card[name]) for name in PARTS}
        owner = card["engine"]
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise DataError(f"{path} is broken ({error}); make it again with `python -m pipelines.trust`.") from error
    if owner != digest(path.parent):
        log.warning("%s belongs to other weights; make it again with `python -m pipelines.trust calibrate`.", path)
        return None
    return TrustLimits(**parts, about=card.get("about", {}))


def _ranges(card: Mapping[str, list[float | None]]) -> dict[str, Range]:
    ends = (-math.inf, math.inf)
    return {
        name: (float(ends[0] if low is None else low), float(ends[1] if high is None else high))
        for name, (low, high) in card.items()
    }


def _plain(value: Any) -> Any:
    """JSON knows no infinity: an open end is null."""
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value
