"""Plans against what was not measured: pairs of a scene and a budget, on clips that the measured data do not hold.

On such a clip every choice is measured, so that the best one is known: the cheapest that meets both budgets, or, where
only a frame budget is given, the one of the least error within it. A plan is good when it misses neither the best time
(with an error budget) or the least error (without) nor the budgets by more than `TOLERANCE`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from zsdt.errors import DataError, RunRejected
from zsdt.planning.budget import Budget, Motion
from zsdt.planning.models import LOOKS, Measured
from zsdt.planning.planner import percent, plan_beam, plan_glass
from zsdt.scene import Foam
from zsdt.twin.glass_scene import GlassTwinScene
from zsdt.twin.twin_scene import BeamTwinScene

TOLERANCE = 0.2


@dataclass(frozen=True)
class Pair:
    """A scene and a budget. kind: beam or glass; clip: its number in the held-out set; error [-] and frame_ms of
    the machine of the data; planar: whether the scene says so."""

    kind: str
    clip: int
    fields: tuple[str, ...]
    error: float | None = None
    frame_ms: float | None = None
    planar: bool = True
    motion: Motion = Motion.any


@dataclass
class Judged:
    """A pair with its plan. words: of the plan or of the refusal. choice, best: in words, empty where there is none;
    their measured time [ms] and error [-]. points: all choices on the clip, (words, ms, error)."""

    pair: Pair
    scene: str
    words: str
    choice: str = ""
    frame_ms: float = math.nan
    error: float = math.nan
    expected_ms: float = math.nan
    expected_error: float = math.nan
    best: str = ""
    best_ms: float = math.nan
    best_error: float = math.nan
    refused: bool = False
    good: bool = False
    points: list[tuple[str, float, float]] = field(default_factory=list)


def judge_pairs(pairs: Sequence[Pair], data: Measured, held_out: Measured) -> list[Judged]:
    """Every pair planned by `data` and held against all choices of its clip in `held_out`."""
    return [judge(pair, data, held_out) for pair in pairs]


def judge(pair: Pair, data: Measured, held_out: Measured) -> Judged:
    """One pair. Raises: DataError where its clip was not measured."""
    rows = held_out.rows[held_out.rows["clip"] == f"clip_{pair.clip:03d}"]
    if rows.empty:
        raise DataError(f"Held-out clip {pair.clip} of a {pair.kind} was not measured; run --validate again.")
    row = rows.iloc[0]
    scene, budget, name = _posed(pair, row)
    points = {
        held_out.choices[k]: _figures(pair, held_out, held_out.rows.iloc[k], data)
        for k in rows.index
        if held_out.choices[k] in data.known
    }
    judged = Judged(pair, name, "")
    try:
        plan = (plan_beam if pair.kind == "beam" else plan_glass)(scene, budget, data)
    except RunRejected as refusal:
        judged.words, judged.refused = str(refusal), True
    allowed = points if pair.kind == "glass" or pair.planar else {c: p for c, p in points.items() if not c.one_layer}
    judged.points = [(choice.words(scene), *point) for choice, point in allowed.items()]
    best = _best(pair, allowed)
    if best is not None:
        judged.best, (judged.best_ms, judged.best_error) = best.words(scene), allowed[best]
    if judged.refused:
        judged.good = best is None
        return judged
    judged.words, judged.choice = plan.words, plan.choice.words(scene)
    judged.frame_ms, judged.error = points[plan.choice]
    judged.expected_ms, judged.expected_error = plan.expected.frame_ms, max(plan.expected.errors.values())
    judged.good = _is_good(pair, judged)
    return judged


def _posed(pair: Pair, row: Any) -> tuple[Any, Budget, str]:
    """Scene and budget of a pair as a person would tell them, and its name."""
    budget = Budget(error=pair.error, frame_ms=pair.frame_ms, speed=1.0, motion=pair.motion)
    fields = list(pair.fields)
    if pair.kind == "glass":
        scene = GlassTwinScene(fields=fields, fps=float(row["fps"]))
        return scene, budget, f"glass: {row['regime']}, {1e6 * row['volume']:.0f} ml"
    length, width, height = (float(row[name]) for name in ("length", "width", "height"))
    beam = BeamTwinScene(
        width=width, pitch=float(row["pitch"]), fps=float(row["fps"]), material=Foam(), fields=fields,
        planar=pair.planar,
    )  # fmt: skip
    name = f"beam: {100 * length:.0f} x {100 * width:.0f} x {100 * height:.0f} cm, {row['regime']}"
    return beam, replace(budget, length=length, height=height), name


def _figures(pair: Pair, held_out: Measured, row: Any, data: Measured) -> tuple[float, float]:
    """Time [ms] of a frame on the machine of the data, and the largest error of the wanted fields [-]."""
    decodes = pair.kind == "glass" or bool({"stress", "von_mises"} & set(pair.fields))
    parts = {p: float(row.get(f"{p}_ms", 0.0)) for p in held_out.parts if p != "decode" or decodes}
    looks = sum(ms for part, ms in parts.items() if part in LOOKS)
    whole = sum(parts.values()) - looks * (1.0 - 1.0 / float(row["look_every"]))
    return whole * data.reference_ms / float(row["reference_ms"]), max(float(row[name]) for name in pair.fields)


def _best(pair: Pair, points: dict[Any, tuple[float, float]]) -> Any:
    """The best choice by what was measured, None where none meets the budgets."""
    most_error, most_ms = pair.error or math.inf, pair.frame_ms or math.inf
    good = {c: p for c, p in points.items() if p[1] <= most_error and p[0] <= most_ms}
    if not good:
        return None
    return min(good, key=lambda c: good[c] if pair.error is not None else good[c][::-1])


def _is_good(pair: Pair, judged: Judged) -> bool:
    slack = 1.0 + TOLERANCE
    if judged.error > slack * (pair.error or math.inf) or judged.frame_ms > slack * (pair.frame_ms or math.inf):
        return False
    if not judged.best:
        return False
    if pair.error is not None:
        return judged.frame_ms <= slack * judged.best_ms
    return judged.error <= slack * judged.best_error


def asked(pair: Pair) -> str:
    """The budget of a pair for people."""
    parts = [] if pair.error is None else [f"{percent(pair.error)} of {' and '.join(pair.fields)}"]
    parts += [] if pair.frame_ms is None else [f"{pair.frame_ms:g} ms"]
    if pair.error is None:
        parts.append(f"least error of {' and '.join(pair.fields)}")
    return ", ".join(parts)


# Clips of beams: 55x30x20, 65x20x10, 50x30x20, 45x20x20, 45x25x10, 40x10x20 cm; dynamic and hand in turn. The budgets
# were chosen by the measured data, before any of these clips was measured.
PAIRS = (
    Pair("beam", 1, ("von_mises",), error=0.35, motion=Motion.hand, planar=False),
    Pair("beam", 2, ("velocity",), frame_ms=4.5, motion=Motion.dynamic),
    Pair("beam", 3, ("position",), error=0.08, motion=Motion.hand, planar=False),
    Pair("beam", 4, ("von_mises",), frame_ms=7.0, motion=Motion.dynamic),
    Pair("beam", 5, ("stress",), frame_ms=3.5, motion=Motion.hand),
    Pair("beam", 0, ("stress",), error=0.02, motion=Motion.dynamic),
    Pair("beam", 1, ("von_mises",), error=0.35, frame_ms=0.3, motion=Motion.hand),
    Pair("glass", 0, ("velocity",), error=0.6),
    Pair("glass", 1, ("velocity",), frame_ms=60.0),
    Pair("glass", 2, ("velocity",), frame_ms=30.0),
    Pair("glass", 3, ("position",), error=0.05),
    Pair("glass", 4, ("position",), frame_ms=25.0),
    Pair("glass", 0, ("velocity",), error=0.02),
    Pair("glass", 1, ("velocity", "position"), error=0.6, frame_ms=2.0),
)
