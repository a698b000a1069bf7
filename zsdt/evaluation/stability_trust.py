"""What the trust monitor said of a run, frame by frame, as the stability table wants it."""

from __future__ import annotations

from zsdt.tignn.engine import Rollout
from zsdt.trajectory import Trajectory
from zsdt.twin.trust import TrustSeries, load_limits, watch_rollout


def flags_of_rollout(folder: str, told: Trajectory, rollout: Rollout) -> list[str]:
    """Flags of every frame of a network that runs alone, "" where there is none."""
    return list(watch_rollout(load_limits(folder), told.body, rollout, told.load).flags)


def flags_of_log(trust: TrustSeries | None) -> list[str] | None:
    """Flags of every frame of a twin, "" where there is none."""
    return None if trust is None else list(trust.flags)
