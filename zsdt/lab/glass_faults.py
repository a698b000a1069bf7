"""What goes wrong in front of a glass: the faults of `zsdt.lab.faults`, a hand before it, and its leaving the picture.

Empty glasses, two glasses and no glass at all are clips of their own (`zsdt.lab.glass_lab.Contents`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from zsdt.errors import OptionError
from zsdt.lab.faults import Fault, FaultOptions, FaultPlan, plan_faults
from zsdt.lab.glass_clips import GlassClip
from zsdt.lab.glass_shooting import outline_points
from zsdt.lab.glass_view import Glass

MARGIN = 6.0  # px that a hand reaches over what it hides


@dataclass
class GlassFaultOptions(FaultOptions):
    """Which faults a run gets; see `FaultOptions`.

    occlude_share: share of the glass's width that a hand hides, from the right, or from the left if `occlude_clamp`.
    leave_frames: within how many frames from `leave_start` on the camera turns away until the glass is out of the
    picture (0: never); after `leave_away` frames without it, it turns back as fast.
    """

    leave_start: int = 30
    leave_frames: int = 0
    leave_away: int = 10

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(self.leave_frames, self.leave_away, self.leave_start) < 0:
            raise OptionError("leave_start, leave_frames and leave_away count frames; they cannot be negative.")


def glass_box(clip: GlassClip, frame: int) -> tuple[float, float, float, float]:
    """(left, top, right, bottom) px of the true outline of the glass in a frame."""
    scene = clip.scene
    vessel = clip.truth.body.vessel
    if vessel is None:
        raise OptionError(f"The truth of {clip.name} has no vessel.")
    glass = Glass(vessel, scene.wall, scene.floor, clip.pose[frame], None, scene.glass_index, scene.liquid_index)
    pixels = clip.true_camera.project(outline_points(glass))
    return (*pixels.min(axis=0).tolist(), *pixels.max(axis=0).tolist())


def plan_glass_faults(options: GlassFaultOptions, clip: GlassClip) -> FaultPlan:
    """The faults of a clip."""
    frames = len(clip.pose)
    plan = plan_faults(replace(options, occlude_share=0.0), frames)
    if options.occlude_share > 0:
        first = max(options.occlude_start, options.protect)
        for frame in range(first, min(options.occlude_start + options.occlude_frames, frames)):
            left, top, right, bottom = glass_box(clip, frame)
            hidden = options.occlude_share * (right - left)
            left, right = (left - MARGIN, left + hidden) if options.occlude_clamp else (right - hidden, right + MARGIN)
            plan.of.setdefault(frame, set()).add(Fault.occluded)
            plan.boxes[frame] = (int(left), int(top - MARGIN), int(right), int(bottom + MARGIN))
    if options.leave_frames > 0:
        _leave(plan, options, clip)
    return plan


def _leave(plan: FaultPlan, options: GlassFaultOptions, clip: GlassClip) -> None:
    """Turns the camera away from the glass and back, to the side on which that is shorter."""
    width = clip.camera.width
    left, _, right, _ = glass_box(clip, min(options.leave_start, len(clip.pose) - 1))
    far = -(right + MARGIN) if right < width - left else width - left + MARGIN
    start, turn = max(options.leave_start, options.protect), options.leave_frames
    knots = np.cumsum([start, turn, options.leave_away, turn])
    for frame in range(start, min(int(knots[-1]), len(clip.pose))):
        share = float(np.interp(frame, knots, [0.0, 1.0, 1.0, 0.0]))
        plan.of.setdefault(frame, set()).add(Fault.shifted)
        plan.shift[frame] = far * (3.0 * share**2 - 2.0 * share**3)
