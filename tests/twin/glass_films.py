"""A film of a glass for tests of the loop: exact masks of the liquid of `liquid_scenes`, no picture painted."""

from functools import cache

import cv2
import numpy as np

from tests.twin.liquid_scenes import FPS, FRAMES, LEVEL, RADIUS, RAMP, SHAPE, SPEED, nudge, reality
from zsdt.evaluation.glass_scenes import GlassScene, masks, side_camera
from zsdt.perception.glass_segmentation import GlassMasks
from zsdt.perception.glass_window import Window
from zsdt.perception.video import VideoFrame

LEAD = 8  # frames of even motion before the stop
RAMP_FRAMES = round(RAMP * FPS)
T0 = LEAD + RAMP_FRAMES
COUNT = T0 + FRAMES
SIZE = (400, 250)
# It looks down steeply enough to see the far wall behind any wave: the drawn surface is level into the depth.
CAMERA = side_camera(height=0.23, look_down=0.36, focal=700.0, size=SIZE)


def place(frame):
    """x [m] of the vessel: it comes from the left and stops at zero within the ramp."""
    time = (frame - LEAD) / FPS
    fine = np.linspace(0.0, RAMP, 200)
    # Velocity of `stop()`: a smooth ramp; integrated from the end backwards.
    from tests.twin.liquid_scenes import stop

    speed = np.array([stop().velocity(t)[0] for t in fine])
    left = np.append(np.cumsum((0.5 * (speed[1:] + speed[:-1]) * np.diff(fine))[::-1])[::-1], 0.0)
    return -left[0] + SPEED * time if time < 0 else -float(np.interp(time, fine, left))


def moved_again(frame):
    """x [m] of a vessel that is moved once more after it has stopped."""
    speed = np.cumsum([0.0, *(nudge(k)[0] / FPS for k in range(FRAMES))])
    way = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) / FPS)])
    return place(frame) + way[max(frame - T0, 0)]


@cache
def film(again=False):
    """Masks of all frames: container and liquid, 0 to 255; again: of a glass that is moved once more."""
    true = reality(again=again)
    calm = [np.full(len(true.places), LEVEL)] * LEAD
    shown = []
    for frame, height in enumerate([*calm, *true.before, *true.height]):
        curve = np.polynomial.polynomial.polyfit(true.places[:, 0], height, 4)
        shown.append(masks(GlassScene(SHAPE, curve, CAMERA, x=(moved_again if again else place)(frame))))
    return shown


def room():
    """A background with structure."""
    rng = np.random.default_rng(7)
    coarse = sum(
        cv2.resize(rng.normal(0.0, k, (SIZE[1] // k, SIZE[0] // k)), SIZE, interpolation=cv2.INTER_CUBIC)
        for k in (4, 12, 40)
    )
    return np.repeat(np.clip(120.0 + 45.0 * coarse / coarse.std(), 0, 245)[..., None], 3, axis=2).astype(np.uint8)


class FilmSource:
    """Frames whose pictures hold nothing but their number and light; some are lost."""

    name, fps, size = "film", FPS, SIZE

    def __init__(self, lost=(), dark=(), frozen=(), frames=COUNT, turned=None):
        """turned: frame -> px by which the camera has turned to the side, before a room with structure."""
        self.turned, self.room = turned, room() if turned else None
        self.lost, self.dark, self.frozen, self.missing = set(lost), set(dark), set(frozen), sorted(lost)
        self.count = frames
        self.rng = np.random.default_rng(0)

    def __iter__(self):
        last = None
        for frame in range(self.count):
            image = self.rng.integers(60, 200, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
            if self.room is not None:
                seen = np.roll(self.room, self.turned.get(frame, 0), axis=1)
                image = (seen + image // 40).astype(np.uint8)
            if frame in self.dark:
                image = np.full_like(image, 1)
            image[0, 0] = [frame % 256, frame // 256, 0]
            if frame in self.frozen and last is not None:
                image = last.copy()
            last = image
            if frame not in self.lost:
                yield VideoFrame(frame, frame / FPS, image)


class FilmSegmenter:
    """Knows the masks of each frame; `spoil(frame, container, liquid)` may change copies of them."""

    def __init__(self, spoil=None, again=False):
        self.spoil, self.again, self.calls = spoil, again, 0

    def masks(self, image, window=None):
        self.calls += 1
        frame = int(image[0, 0, 0]) + 256 * int(image[0, 0, 1])
        container, liquid = (part.copy() for part in (film(True) if self.again else film())[frame])
        if self.spoil is not None:
            self.spoil(frame, container, liquid)
        height, width = container.shape
        window = window or Window.whole(height, width)
        rows, columns = window.inside(height, width)
        found = []
        for part in (container, np.minimum(liquid, container)):
            whole = np.zeros((height, width), np.float32)
            whole[rows, columns] = part[rows, columns] / 255.0
            found.append(whole)
        return GlassMasks(found[0], found[1], window)


assert RADIUS * 2 < 0.08
