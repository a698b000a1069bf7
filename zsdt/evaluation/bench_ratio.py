"""The claim about speed by itself: the seed's network to the letter against the exact form, on the same graph, in turn.

Two graphs: the published beam (756 nodes, 1,980 pairs), and 1,000 particles with a radius chosen so that they have
about 12,000 pairs. Walls are features there for both, so that both have the same nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from zsdt.evaluation.bench import Case, Progress, measure
from zsdt.tignn.engine import Engine
from zsdt.tignn.liquid_body import LiquidBody
from zsdt.tignn.options import TignnOptions, Walls
from zsdt.trajectory import Trajectory

PARTICLES, PAIRS = 1000, 12000
LITERAL = "seed_literal"


def radius_for(trajectory: Trajectory, options: TignnOptions, pairs: int = PAIRS) -> TignnOptions:
    """`options` with walls as features and the cutoff [spacings] at which the first frame has about `pairs` pairs."""
    low, high = 1.05, 3.5
    for _ in range(30):
        middle = 0.5 * (low + high)
        tried = replace(options, liquid=replace(options.liquid, walls=Walls.features, cutoff=middle))
        found = len(LiquidBody(trajectory.body, tried).connect(trajectory.fields["position"][0]).pairs)
        low, high = (middle, high) if found < pairs else (low, middle)
    return tried


def on_radius(engine: Any, trajectory: Trajectory, pairs: int = PAIRS) -> Any:
    """The engine with the radius of `radius_for`, weights as they are."""
    engine.model.options = radius_for(trajectory, engine.model.options, pairs)
    return engine


def compare(
    makers: Mapping[str, Callable[[], Engine]],
    trajectory: Trajectory,
    pairs: int,
    judged: Mapping[str, Mapping[str, Any]],
    rounds: int = 5,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """One row per method: nodes, pairs, ms_p50, ms_p95, peak_mb, times_faster than the seed's network, and what
    `judged` says of its training and its errors.

    Raises: KeyError where the seed's network is not among the makers.
    """
    literal = makers[LITERAL]
    order = {LITERAL: literal} | {name: make for name, make in makers.items() if name != LITERAL}
    cases = [Case(make, trajectory, {"method": name, "pairs": pairs}) for name, make in order.items()]
    rows = measure(cases, rounds, 8, progress=progress)
    return with_ratio([row | dict(judged.get(row["method"], {})) for row in rows])


def with_ratio(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The rows with `times_faster`: milliseconds of the seed's network over those of the row, by the medians."""
    seed = next(row["ms_p50"] for row in rows if row["method"] == LITERAL)
    return [{**row, "times_faster": seed / row["ms_p50"]} for row in rows]
