"""What the twin of a glass sees of a frame: is there anything to be seen, where are glass and liquid, does it move."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsdt.perception.camera import Camera
from zsdt.perception.camera_turn import CameraTurn
from zsdt.perception.frame_quality import FrameQuality, QualityJudge
from zsdt.perception.glass_segmentation import GlassMasks, GlassSegmenter
from zsdt.perception.mask_edges import MaskEdges, read_edges
from zsdt.perception.region_of_interest import RegionOfInterest, RegionOptions
from zsdt.perception.vessel_track import Motion, RestDetector, RestOptions, VesselTracker
from zsdt.twin.glass_log import GlassStatus
from zsdt.twin.loop_common import Image

NO_OUTLINE = np.zeros((0, 2))


@dataclass(frozen=True)
class Sighting:
    """What was seen in a frame.

    fault: why nothing was, None where something was. edges: of the masks, as the camera of the first picture would have
    seen them; x [m]: of the vessel's axis in the room, NaN where not seen; motion: of the vessel so far; outline
    [points, 2] px: of the liquid; others: how many more glasses the window showed; turned (u, v) [px]: by how much the
    picture has moved with the camera since the first.
    """

    index: int
    time: float
    fault: GlassStatus | None
    edges: MaskEdges | None = None
    x: float = float("nan")
    motion: Motion = Motion.unknown
    outline: Float[np.ndarray, "_ 2"] = field(default_factory=lambda: NO_OUTLINE)
    others: int = 0
    turned: Float[np.ndarray, "2"] = field(default_factory=lambda: np.zeros(2))

    @property
    def has_liquid(self) -> bool:
        """Whether a glass with liquid was seen."""
        return self.edges is not None and self.edges.has_liquid


class GlassWatch:
    """Follows one glass: the largest of the first picture that shows one, and stays with it.

    rest: knows when it stopped; segment_ms: time of the last segmentation; seen, wet: frames with a glass, with liquid.
    """

    def __init__(self, segmenter: GlassSegmenter, camera: Camera, region: RegionOptions, rest: RestOptions):
        self.region = RegionOfInterest(segmenter, region)
        self.tracker, self.rest = VesselTracker(camera), RestDetector(rest)
        self.turn, self._turned = CameraTurn(), np.zeros(2)
        self.judge: QualityJudge | None = None
        self.seen = self.wet = 0

    def segment(self, image: Image, motion: float) -> tuple[GlassMasks | None, GlassStatus | None]:
        """Masks of a picture, or why there are none. motion [px]: by how much the surface should have moved."""
        if self.judge is not None:
            quality = self.judge.before(image, motion)
            if quality is FrameQuality.good:
                quality = self.judge.lit(self._crop(image))
            if quality is not FrameQuality.good:
                return None, GlassStatus(quality.value)
        masks = self.region.masks(image)
        if self.region.instance is None:
            blurred = self.judge is not None and self.judge.sharp(self._crop(image)) is FrameQuality.blurred
            return None, GlassStatus.blurred if blurred else GlassStatus.no_glass
        self._where = self.region.instance.box
        self._turned = self.turn.update(image, self._where)
        if self.judge is None:
            self.judge = QualityJudge(image, self._crop(image))
        self.judge.accept()
        return masks, None

    def _crop(self, image: Image) -> UInt8[np.ndarray, "a b"]:
        """Grey picture of the glass, where it was seen last."""
        box = self._where
        part = np.ascontiguousarray(image[box.top : box.bottom, box.left : box.right])
        return np.asarray(cv2.cvtColor(part, cv2.COLOR_BGR2GRAY), np.uint8)

    def read(self, index: int, time: float, masks: GlassMasks | None, fault: GlassStatus | None) -> Sighting:
        """What the masks of a frame say."""
        if masks is None:
            return Sighting(index, time, fault, motion=self.rest.state)
        height, width = masks.container.shape
        rows, columns = masks.window.inside(height, width)
        container = np.ascontiguousarray(masks.container[rows, columns])
        liquid = np.ascontiguousarray(masks.liquid[rows, columns])
        edges = read_edges(container, liquid, (columns.start, rows.start), (width, height)).steadied(self._turned)
        if not edges.has_glass:
            return Sighting(index, time, GlassStatus.no_glass, motion=self.rest.state)
        self.seen += 1
        self.wet += int(edges.has_liquid)
        x = self.tracker.update(edges)
        motion = self.rest.update(time, x)
        outline = _outline(liquid, (columns.start, rows.start))
        return Sighting(index, time, None, edges, x, motion, outline, self.region.others, self._turned)


def _outline(liquid: Float[np.ndarray, "h w"], origin: tuple[int, int]) -> Float[np.ndarray, "points 2"]:
    """Contour [points, 2] px of the largest patch of liquid."""
    found, _ = cv2.findContours((liquid > 0.5).view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if not found:
        return NO_OUTLINE
    return max(found, key=len).reshape(-1, 2).astype(np.float64) + origin
