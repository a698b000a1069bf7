"""What the trust monitor said of a run, frame by frame, as the stability table wants it."""

from __future__ import annotations

from zsdt.tignn.engine import Rollout
from zsdt.trajectory import Trajectory


def flags_of_rollout(folder: str, told: Trajectory, rollout: Rollout) -> list[str] | None:
    """Flags of every frame of a network that runs alone, "" where there is none."""
    try:
        from zsdt.twin.trust import load_limits, watch_rollout
    except ImportError:
        return None
    return list(watch_rollout(load_limits(folder), told.body, rollout, told.load).flags)


def flags_of_log(log: object) -> list[str] | None:
    """Flags of every frame of a twin, "" where there is none."""
    series = getattr(log, "trust", None)
    return None if series is None else list(series.flags)
