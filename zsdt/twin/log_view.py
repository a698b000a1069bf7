"""A run of the twin in the dress that overlay, recording and plots read."""

from __future__ import annotations

import numpy as np

from zsdt.twin.twin_log import FAULTS, TwinLog
from zsdt.twin.twin_view import TwinView

_FAULTS = {fault.value for fault in FAULTS}


def view_of(log: TwinLog, source: str = "") -> TwinView:
    """The view of a run; source: what the pictures are, such as ``virtual lab``."""
    shape = (log.count, *log.front_nodes.shape)
    tracked = log.mode == "closed"
    return TwinView(
        name=f"{log.mode} loop",
        body=log.body,
        front=log.front_nodes,
        camera=log.camera,
        frames=log.frames,
        times=log.times,
        positions=log.positions,
        fields=log.fields,
        seen=log.seen.reshape(shape) if tracked else np.ones(shape, bool),
        innovation=log.innovation.reshape(shape),
        latency=log.latency,
        faults=[status if status in _FAULTS else "" for status in log.status],
        account=log.account,
        source=source,
        closed=tracked,
        trust=log.trust,
    )
