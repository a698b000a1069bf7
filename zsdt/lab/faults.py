"""What goes wrong between a scene and a twin: hidden parts, lost, doubled, dark and blurred frames, changes of light.

Faults are put over the frames of any source while they are read; the source itself stays as it is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsdt.errors import OptionError
from zsdt.perception.video import FrameSource, VideoFrame


class Fault(Enum):
    """What can happen to a frame."""

    dropped = "dropped"
    doubled = "doubled"
    dark = "dark"
    blurred = "blurred"
    occluded = "occluded"
    light = "light"
    shifted = "shifted"


@dataclass
class FaultOptions:
    """Which faults a run gets.

    dropped, doubled, dark, blurred: shares of the frames. occlude_start, occlude_frames: when something hides the
    part `occlude_share` of the nodes (0: never), counted from the tip, or from the clamp if `occlude_clamp`.
    light_start: frame from which the light changes to `light_factor` within `light_frames` (factor 1: never).
    protect: first frames that no fault touches. seed.
    """

    dropped: float = 0.0
    doubled: float = 0.0
    dark: float = 0.0
    blurred: float = 0.0
    occlude_start: int = 30
    occlude_frames: int = 30
    occlude_share: float = 0.0
    occlude_clamp: bool = False
    light_start: int = 30
    light_frames: int = 10
    light_factor: float = 1.0
    protect: int = 2
    seed: int = 0

    def __post_init__(self) -> None:
        shares = (self.dropped, self.doubled, self.dark, self.blurred)
        if min(shares) < 0 or sum(shares) > 1 or not 0 <= self.occlude_share <= 1:
            raise OptionError("Shares of faulty frames must be 0 to 1 and together not above 1.")
        if self.light_factor <= 0 or self.light_frames < 1 or self.protect < 1:
            raise OptionError("light_factor must be positive, light_frames and protect at least 1.")


@dataclass
class FaultPlan:
    """Faults of each frame: `of` frame -> faults; `boxes` frame -> (left, top, right, bottom) px of what hides the
    body; `light` frame -> factor on brightness; `shift` frame -> px by which the picture has moved to the right."""

    of: dict[int, set[Fault]] = field(default_factory=dict)
    boxes: dict[int, tuple[int, int, int, int]] = field(default_factory=dict)
    light: dict[int, float] = field(default_factory=dict)
    shift: dict[int, float] = field(default_factory=dict)


def plan_faults(
    options: FaultOptions, frames: int, pixels: Float[np.ndarray, "frames columns rows 2"] | None = None
) -> FaultPlan:
    """The faults of a video of `frames` frames.

    pixels: of the nodes in each frame; they say where an occluder must be to hide the wanted share of the nodes.
    Raises: OptionError where nodes shall be hidden and `pixels` is missing.
    """
    rng = np.random.default_rng([options.seed, 0xFA])
    plan = FaultPlan()
    names = (Fault.dropped, Fault.doubled, Fault.dark, Fault.blurred)
    bounds = np.cumsum([options.dropped, options.doubled, options.dark, options.blurred])
    for frame, chance in enumerate(rng.random(frames)):
        kind = int(np.searchsorted(bounds, chance, side="right"))
        if frame >= options.protect and kind < len(names):
            plan.of.setdefault(frame, set()).add(names[kind])
    if options.occlude_share > 0:
        if pixels is None:
            raise OptionError("An occluder needs the pixels of the nodes to know what it hides; give them.")
        first = max(options.occlude_start, options.protect)
        for frame in range(first, min(options.occlude_start + options.occlude_frames, frames)):
            plan.of.setdefault(frame, set()).add(Fault.occluded)
            plan.boxes[frame] = hiding_box(pixels[frame], options.occlude_share, options.occlude_clamp)
    if options.light_factor != 1.0:
        for frame in range(max(options.light_start, options.protect), frames):
            part = min((frame - options.light_start + 1) / options.light_frames, 1.0)
            plan.of.setdefault(frame, set()).add(Fault.light)
            plan.light[frame] = 1.0 + (options.light_factor - 1.0) * part
    return plan


def hiding_box(
    pixels: Float[np.ndarray, "columns rows 2"], share: float, from_clamp: bool = False, margin: float = 12.0
) -> tuple[int, int, int, int]:
    """(left, top, right, bottom) px that covers the columns nearest to the tip (or clamp) that make up a share."""
    columns = len(pixels)
    count = int(np.clip(round(share * columns), 1, columns))
    hidden = pixels[:count] if from_clamp else pixels[columns - count :]
    flat = hidden.reshape(-1, 2)
    low, high = flat.min(axis=0) - margin, flat.max(axis=0) + margin
    if 0 < count < columns:
        # Between the last hidden and the first seen column, so that the latter is not touched.
        seen = pixels[count] if from_clamp else pixels[columns - count - 1]
        edge = pixels[count - 1] if from_clamp else pixels[columns - count]
        border = 0.5 * (seen[:, 0].mean() + edge[:, 0].mean())
        if seen[:, 0].mean() < edge[:, 0].mean():
            low[0] = border
        else:
            high[0] = border
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def spoil(
    image: UInt8[np.ndarray, "height width 3"], faults: set[Fault], plan: FaultPlan, frame: int
) -> UInt8[np.ndarray, "height width 3"]:
    """The picture of a frame with its faults, but for those that lose or repeat the whole frame."""
    result = image
    if Fault.shifted in faults:
        moved = np.array([[1.0, 0.0, plan.shift[frame]], [0.0, 1.0, 0.0]])
        result = cv2.warpAffine(result, moved, image.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)
    if Fault.occluded in faults:
        result = result.copy()
        left, top, right, bottom = plan.boxes[frame]
        left, top = max(left, 0), max(top, 0)
        part = result[top : max(bottom, top), left : max(right, left)]
        # A sleeve: skin-free, folded cloth that passes by.
        fold = 70.0 + 22.0 * np.sin(np.arange(part.shape[1]) / 11.0 + 0.35 * frame)
        part[:] = (fold[:, None] * [1.25, 0.9, 0.8]).clip(0, 255).astype(np.uint8)
    if Fault.light in faults:
        result = cv2.convertScaleAbs(result, alpha=plan.light[frame])
    if Fault.dark in faults:
        result = cv2.convertScaleAbs(result, alpha=0.06)
    if Fault.blurred in faults:
        result = cv2.GaussianBlur(result, (0, 0), 9.0)
    return result


class FaultySource:
    """A source whose frames go wrong as a plan says; dropped frames are left out, with their numbers in `missing`."""

    def __init__(self, source: FrameSource, plan: FaultPlan):
        self.source, self.plan = source, plan
        self.name, self.fps, self.size = f"{source.name} with faults", source.fps, source.size
        self.missing: list[int] = []

    @property
    def count(self) -> int | None:
        """Number of frames of the source."""
        return self.source.count

    def __iter__(self) -> Iterator[VideoFrame]:
        self.missing.clear()
        last: np.ndarray | None = None
        for frame in self.source:
            faults = self.plan.of.get(frame.index, set())
            if Fault.dropped in faults:
                self.missing.append(frame.index)
                continue
            image = last if Fault.doubled in faults and last is not None else frame.image
            last = image
            yield VideoFrame(frame.index, frame.time, spoil(image, faults - {Fault.doubled}, self.plan, frame.index))
        self.missing.extend(self.source.missing)
