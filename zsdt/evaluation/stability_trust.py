"""What the trust monitor measured in a run, frame by frame, and which flags that raises by the limits of today.

Rows keep the numbers, not only the flags: limits that are calibrated anew need no case to be run again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from zsdt.tignn.engine import Rollout
from zsdt.trajectory import Body, Trajectory
from zsdt.twin.trust import TrustSeries, watch_rollout
from zsdt.twin.trust_gauges import gauge_of
from zsdt.twin.trust_limits import KINDS, PHYSICS, Flag, load_limits

Gauges = dict[str, list[float]]
NO_NUMBER = (Flag.finite, Flag.restarted)  # flags that no number stands for


def watched(told: Trajectory, rollout: Rollout) -> TrustSeries:
    """What is measured of a network that runs alone."""
    return watch_rollout(None, told.body, rollout, told.load)


def gauges_of(
    series: TrustSeries | None, body: Body, found: Mapping[str, float] | None = None
) -> tuple[list[str] | None, Gauges]:
    """(flags that no number stands for, numbers) of every frame, None and nothing where nobody looked. What of a body
    and of what a twin `found` of it does not change is told once."""
    if series is None:
        return None, {}
    kept = [" ".join(w for w in text.split() if w in NO_NUMBER) for text in series.flags]
    once = {name: [float(x)] for name, x in {**gauge_of(body).card, **(found or {})}.items()}
    return kept, {name: [float(x) for x in values] for name, values in series.values.items()} | once


def flags_by(folder: Path | None, kept: list[str] | None, gauges: Gauges, alone: bool) -> list[str] | None:
    """Flags of every frame by the limits beside the weights in `folder` (physics alone where there are none). alone:
    by those of an engine that nobody corrects."""
    if kept is None:
        return None
    limits = (load_limits(folder) or PHYSICS).within(alone)
    broken: list[set[str]] = [set(text.split()) for text in kept]
    for name, values in gauges.items():
        if name not in limits or name not in KINDS:
            continue
        (low, high), flag = limits[name], KINDS[name].flag.value
        outside = [math.isfinite(x) and not low <= x <= high for x in values]
        for k in range(len(kept)):
            if outside[0] if len(outside) == 1 else outside[k]:
                broken[k].add(flag)
    return [" ".join(flag.value for flag in Flag if flag.value in found) for found in broken]
