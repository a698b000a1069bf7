"""A run of the glass twin in the dress that overlay, recording and plots read."""

from __future__ import annotations

from zsdt.twin.glass_log import GLASS_FAULTS, GlassTwinLog
from zsdt.twin.glass_view import GlassTwinView

_FAULTS = {fault.value for fault in GLASS_FAULTS}


def glass_view_of(log: GlassTwinLog, source: str = "") -> GlassTwinView:
    """The view of a run; source: what the pictures are, such as ``virtual lab``."""
    return GlassTwinView(
        name=f"{log.mode} loop",
        body=log.body,
        camera=log.camera,
        wall=log.wall,
        floor=log.floor,
        start=log.start,
        frames=log.frames,
        times=log.times,
        origin=log.origin,
        positions=log.positions,
        places=log.places,
        level=log.level,
        fields=log.fields,
        predicted_level=log.predicted_level,
        seen_level=log.seen_level,
        seen_px=log.seen_px,
        outlines=log.outline,
        latency=log.latency,
        faults=[status if status in _FAULTS else "" for status in log.status],
        phases=[status if k < log.start else "" for k, status in enumerate(log.status)],
        account=log.account,
        whole=log.whole,
        viscosity=log.viscosity,
        source=source,
        closed=log.mode == "closed",
        trust=log.trust,
    )
