"""Tracks the crossings of a grid through a video: pyramidal Lucas-Kanade, anchored to the first frame (seed, 3D).

A frame goes through four steps. *Guess*: where the twin expects the nodes, plus what it last was wrong by; constant
velocity where there is no twin. *Flow*: pyramidal Lucas-Kanade from the last good frame, forward and backward, at half
resolution: it only has to bring every node within a few pixels. *Anchor*: each node is aligned with its appearance in
the first frame (`reference_patches`), so errors do not add up. *Judge*: a node is seen only if it resembles its first
appearance, moves like its neighbours and is where it can be. Nodes that fail are looked for again where their
neighbours say they are, in a coarser image: that is also how lost nodes come back.

The gate around the guess follows the scatter of the innovations themselves. A twin with a wrong material is wrong by
much, but by much everywhere: the gate opens and the beam is not lost.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64, Int, UInt8

from zsdt.errors import DataError, OptionError, ZsdtError
from zsdt.perception.frame_quality import FrameQuality, QualityJudge, light
from zsdt.perception.frame_view import COARSE, Region, View, flow_between, grey
from zsdt.perception.local_motion import Neighbourhoods, fill, neighbourhoods, smooth_locally, torn_off, warp_operator
from zsdt.perception.reference_patches import Alignment, ReferencePatches, align, reference_patches
from zsdt.perception.silhouette import grid_cells, silhouette

Picture = UInt8[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w"]
DAMPING = 0.8  # of velocity and innovation for each frame in which nothing is seen, after a few
CALM = 0.25  # of the reach: scatter of the innovations below which the guess needs no flow
STEPS, ROUGHLY, CLOSELY = 8, 0.3, 0.02  # Gauss-Newton steps and px to which they settle, at first and in the end
CLEARLY = 0.02  # by which another guess must score better
FEW, MOST = 0.5, 0.9  # shares of nodes found, below which all or the missing ones are looked for again
PATIENCE, WHOLE = 3, 0.6  # frames for which the grid is lost before it is sought where it began, and its share there
HABIT = 0.1  # part of a new score in a node's usual one
LOST = 0.1  # pitches by which a lost node may contradict its neighbours in addition
TOO_FEW = 0.2  # share of nodes below which a frame may be called blurred


@dataclass
class TrackerOptions:
    """Choices of the tracker; lengths in pixels of the full image.

    window: side of the patches of the first frame (odd). coarse_window: the same in the image of a quarter the size.
    flow_window, flow_levels: of the frame-to-frame flow in the image of half the size (levels 0: no flow).
    smooth: a 3x3 blur against noise before nodes are aligned. mask_background: only pixels within the grid's cells
    count, `silhouette_inset` inside their outline. reach: how far a node may be from where the flow puts it.
    least_score: correlation with the first frame that a node needs, lowered with the whole picture by `score_drop`
    from what most nodes reach (blur), never below `score_floor`; a lost node comes back with at most `regain_drop`
    less than its own usual one. forward_backward: most disagreement of the flow.
    neighbour_tolerance: most disagreement with the neighbours. gate_factor, gate_least: the gate is that many times
    the scatter of the innovations, and at least so wide. most_error: estimated error above which a node is lost.
    """

    window: int = 21
    coarse_window: int = 11
    flow_window: int = 15
    flow_levels: int = 2
    smooth: bool = True
    mask_background: bool = True
    silhouette_inset: int = 1
    reach: float = 4.0
    least_score: float = 0.9
    score_drop: float = 0.1
    score_floor: float = 0.5
    regain_drop: float = 0.04
    forward_backward: float = 1.0
    neighbour_tolerance: float = 1.0
    gate_factor: float = 4.0
    gate_least: float = 6.0
    most_error: float = 1.0

    def __post_init__(self) -> None:
        for name, least in (("window", 7), ("coarse_window", 5), ("flow_window", 5)):
            if getattr(self, name) < least or getattr(self, name) % 2 == 0:
                raise OptionError(f"tracker.{name} must be odd and at least {least}.")
        if not 0 <= self.flow_levels <= 5 or self.silhouette_inset < 0:
            raise OptionError("tracker.flow_levels must lie in [0, 5] and silhouette_inset be at least 0.")
        if not 0.0 < self.score_floor <= self.least_score < 1.0 or self.score_drop < 0.0:
            raise OptionError("tracker needs 0 < score_floor <= least_score < 1 and drops of at least 0.")
        lengths = (self.reach, self.forward_backward, self.neighbour_tolerance, self.gate_least, self.most_error)
        if min(lengths) <= 0.0 or self.gate_factor < 1.0:
            raise OptionError("tracker's lengths must be positive and gate_factor at least 1.")


@dataclass(frozen=True)
class Tracks:
    """Nodes in a frame: pixels [nodes, 2], seen [nodes], error_px [nodes] (standard deviation; inf where not seen),
    score [nodes] (correlation with the first frame; 0 where not found), quality of the frame.

    Nodes that are not seen carry the prediction, or the motion of their neighbours where there was none.
    """

    pixels: Float64[np.ndarray, "nodes 2"]
    seen: Bool[np.ndarray, " nodes"]
    error_px: Float64[np.ndarray, " nodes"]
    score: Float64[np.ndarray, " nodes"]
    quality: FrameQuality


class GridTracker:
    """Follows nodes of a grid from the first frame on: `start` once, then `track` for every frame."""

    def __init__(self, options: TrackerOptions | None = None):
        self.options = options or TrackerOptions()
        self._view: View | None = None

    def start(self, image: Picture, pixels: Float[np.ndarray, "nodes 2"], edges: Int[np.ndarray, "edges 2"]) -> None:
        """Learns the nodes' appearance from the first frame; edges [edges, 2] as ids of nodes.

        Raises: DataError where nodes lie outside of the image or hardly one has enough texture to be followed.
        """
        picture = grey(image)
        height, width = picture.shape
        inside = (pixels >= 0.0).all(axis=1) & (pixels <= [width - 1.0, height - 1.0]).all(axis=1)
        if not len(pixels) or not inside.all():
            raise DataError(
                f"{int((~inside).sum())} of {len(pixels)} nodes lie outside of the first frame; detect the grid again."
            )
        if len(edges) and (edges.min() < 0 or edges.max() >= len(pixels)):
            raise DataError("An edge of the grid names a node that does not exist; detect the grid again.")
        self._around: Neighbourhoods = neighbourhoods(pixels, edges)
        self._region = Region(2 * self.options.window, self.options.smooth)
        self._take_patches(picture, pixels, edges)
        usable = int(self._fine.usable.sum())
        if usable < min(3, len(pixels)):
            raise DataError(
                f"Only {usable} of {len(pixels)} nodes show enough contrast in the first frame; start from a brighter "
                "and sharper one."
            )
        self._pixels = np.array(pixels, np.float64)
        self._velocity = np.zeros_like(self._pixels)
        self._innovation = np.zeros_like(self._pixels)
        self._scatter = self.options.reach
        self._habit = np.ones(len(pixels))
        self._blind_frames = self._lost_frames = 0
        view = self._region.cut(picture, self._pixels)
        self._light = light(view.half)
        self._judge_quality = QualityJudge(image, view.half)
        view.seen = self._fine.usable.copy()
        self._view = view

    def track(self, image: Picture | None, predicted: Float[np.ndarray, "nodes 2"] | None = None) -> Tracks:
        """Finds the nodes in the next frame; None for a frame that never came.

        predicted: pixels where the twin expects the nodes; without it they are expected to keep their velocity.
        """
        if self._view is None:
            raise ZsdtError("The tracker has seen no first frame; call start before track.")
        momentum = self._pixels + self._velocity
        guess = momentum if predicted is None else predicted + self._innovation
        motion = _share(_length(guess - self._pixels), 0.5)
        quality = self._judge_quality.before(image, motion)
        if quality is not FrameQuality.good or image is None:
            return self._blind(guess, predicted, quality)
        view = self._region.cut(image, guess)
        quality = self._judge_quality.lit(view.half)
        if quality is not FrameQuality.good:
            return self._blind(guess, predicted, quality)
        if predicted is not None:
            guess = self._best(view, (guess, predicted, momentum))
        found, seen, put_right = self._find(view, guess, predicted)
        if seen.mean() < TOO_FEW:
            quality = self._judge_quality.sharp(view.half)
            if quality is not FrameQuality.good:
                return self._blind(guess, predicted, quality)
        self._judge_quality.accept()
        return self._accept(view, put_right, predicted, found, seen)

    # ------------------------------------------------------------------------------------------------ the steps

    def _take_patches(self, picture: Any, pixels: Float[np.ndarray, "nodes 2"], edges: Any) -> None:
        options = self.options
        cells = grid_cells(edges, len(pixels)) if options.mask_background else np.empty((0, 4), np.int64)
        inside = silhouette(picture.shape, pixels, cells, options.silhouette_inset)
        quarter = cv2.pyrDown(cv2.pyrDown(picture))
        thin = cv2.resize(inside, quarter.shape[::-1], interpolation=cv2.INTER_AREA)
        self._fine: ReferencePatches = reference_patches(self._region.quiet(picture), pixels, inside, 0, options.window)
        self._coarse = reference_patches(quarter, pixels, thin, COARSE, options.coarse_window)
        self._warp_of = warp_operator(self._around)

    def _best(self, view: View, candidates: Sequence[Float[np.ndarray, "nodes 2"]]) -> Float[np.ndarray, "nodes 2"]:
        """The candidate at which the nodes look most like themselves in the coarse image; the first where they agree.

        The twin's last error is a good guess of its next one, but not after a prediction that was wrong just once.
        """
        first = candidates[0]
        apart = max(float(np.linalg.norm(other - first, axis=1).max()) for other in candidates[1:])
        if apart < self.options.reach:
            return first
        scores = [self._likeness(view, candidate) for candidate in candidates]
        return candidates[int(np.argmax(scores))] if max(scores) > scores[0] + CLEARLY else first

    def _likeness(self, view: View, pixels: Float[np.ndarray, "nodes 2"]) -> float:
        """Mean score of the coarse patches just there."""
        everyone = np.ones(len(pixels), bool)
        there = align(self._coarse, view.quarter, pixels - view.origin, self._warp(pixels), everyone, np.inf, 1, np.inf)
        return float(there.score.mean())

    def _find(
        self, view: View, guess: Float[np.ndarray, "nodes 2"], predicted: Any
    ) -> tuple[Alignment, Bool[np.ndarray, " nodes"], Float[np.ndarray, "nodes 2"]]:
        """Flow, anchor, judge; and once more for what was not found. Also the guess, put right for lost nodes."""
        everyone = np.ones(len(guess), bool)
        seen = ~everyone
        if self._scatter < CALM * self.options.reach:
            # The twin is good enough to begin from: that saves the flow, a quarter of the time.
            found = self._align(self._fine, view, guess, everyone, self.options.reach)
            seen = self._judge(found, guess)
        if seen.mean() < MOST:
            surprise, trusted = flow_between(
                self._view or view,
                view,
                guess,
                self._light,
                self.options.flow_window,
                self.options.flow_levels,
                self.options.forward_backward,
            )
            smooth = smooth_locally(self._around, surprise, trusted)
            near = _length(surprise - smooth) < self.options.neighbour_tolerance
            start = guess + np.where((trusted & near)[:, None], surprise, smooth)
            found = self._align(self._fine, view, start, everyone, self.options.reach)
            seen = self._judge(found, guess)
        if seen.mean() < FEW:
            found, seen, guess = self._search(view, found, seen, guess, predicted)
        if seen.mean() < MOST and seen.any():
            lost = ~seen
            implied = self._filled(found, seen, predicted)
            guess = np.where(lost[:, None], implied - smooth_locally(self._around, found.pixels - guess, seen), guess)
            again = self._from_afar(view, implied, lost)
            for name in ("pixels", "score", "error"):
                getattr(found, name)[lost] = getattr(again, name)[lost]
            seen = self._judge(found, guess)
        return found, seen, guess

    def _search(
        self, view: View, found: Alignment, seen: Any, guess: Float[np.ndarray, "nodes 2"], predicted: Any
    ) -> tuple[Alignment, Bool[np.ndarray, " nodes"], Float[np.ndarray, "nodes 2"]]:
        """Looks for the whole grid where it is expected and where it was; without a twin, that has been lost for
        some frames, also where it began: there most of it must be found at once."""
        everyone = np.ones(len(guess), bool)
        places = [(guess, guess, int(seen.sum())), (self._pixels, guess, int(seen.sum()))]
        if predicted is None and self._lost_frames >= PATIENCE:
            places.append((self._around.pixels, self._around.pixels, int(WHOLE * len(guess))))
        for start, expected, least in places:
            other = self._from_afar(view, start, everyone)
            other_seen = self._judge(other, expected)
            if other_seen.sum() > max(least, seen.sum()):
                found, seen, guess = other, other_seen, expected
        return found, seen, guess

    def _filled(
        self, found: Alignment, seen: Bool[np.ndarray, " nodes"], predicted: Any
    ) -> Float[np.ndarray, "nodes 2"]:
        """Pixels of the seen nodes, and for the others what the shape of the grid says: that of the prediction, or
        of the first frame. Nothing of it is carried from frame to frame, so lost nodes do not drift away."""
        shape = self._around.pixels if predicted is None else predicted
        return shape + fill(self._around, found.pixels - shape, seen)

    def _align(
        self, patches: ReferencePatches, view: View, start: Float[np.ndarray, "nodes 2"], chosen: Any, reach: Any
    ) -> Alignment:
        """Aligns with the first frame under the deformation that the starting positions imply."""
        image = view.image if patches.level == 0 else view.quarter
        found = align(patches, image, start - view.origin, self._warp(start), chosen, reach, STEPS, ROUGHLY)
        if patches.level == 0:
            # What was found tells the deformation better than the start did, where neighbours agree on it.
            moved = found.pixels + view.origin - start
            sound = found.score > self.options.score_floor
            smooth = smooth_locally(self._around, moved, sound)
            sound &= _length(moved - smooth) < self.options.neighbour_tolerance
            better = start + np.where(sound[:, None], moved, np.where(chosen[:, None], smooth, 0.0))
            found = align(patches, image, better - view.origin, self._warp(better), chosen, reach, STEPS, CLOSELY)
        found.pixels += view.origin
        return found

    def _warp(self, pixels: Float[np.ndarray, "nodes 2"]) -> Float[np.ndarray, "nodes 2 5"]:
        """Deformation of every window since the first frame: slopes and curvatures of the grid at its nodes."""
        warp = np.moveaxis(self._warp_of @ (pixels - self._around.pixels), 0, 2)
        warp[:, 0, 0] += 1.0
        warp[:, 1, 1] += 1.0
        return warp

    def _from_afar(self, view: View, start: Float[np.ndarray, "nodes 2"], chosen: Any) -> Alignment:
        """Looks for nodes up to 0.4 pitches away, first in the coarse image; never as far as the next crossing."""
        rough = self._align(self._coarse, view, start, chosen, 0.4 * self._around.pitch)
        better = smooth_locally(self._around, rough.pixels - start, chosen & (rough.score > self.options.score_floor))
        own = rough.score > self.options.least_score
        near = np.linalg.norm(rough.pixels - start - better, axis=1) < self.options.neighbour_tolerance
        start = np.where((chosen & own & near)[:, None], rough.pixels, start + np.where(chosen[:, None], better, 0.0))
        return self._align(self._fine, view, start, chosen, self.options.reach)

    def _judge(self, found: Alignment, guess: Float[np.ndarray, "nodes 2"]) -> Bool[np.ndarray, " nodes"]:
        """Which nodes look like themselves, move like their neighbours and lie within the gate."""
        options = self.options
        usual = _share(found.score[self._fine.usable], 0.75)
        least = np.clip(usual - options.score_drop, options.score_floor, options.least_score)
        seen = (found.score >= least) & (found.error <= options.most_error)
        if self._view is not None:
            # A lost node has to look as it usually did: half behind something it looks only somewhat like itself.
            seen &= self._view.seen | (found.score >= usual * self._habit - options.regain_drop)
        if not seen.any():
            return seen
        surprise = found.pixels - guess
        momentum = found.pixels - self._pixels - self._velocity
        far = np.minimum(_length(surprise), _length(momentum))
        seen &= far <= self._gate(far[seen])
        # Where a lost node is expected is known less well: its neighbours' word about it has that much less weight.
        room = np.zeros(len(guess)) if self._view is None else np.where(self._view.seen, 0.0, LOST * self._around.pitch)
        for _ in range(2):
            if not seen.any():
                break
            apart = _length(surprise - smooth_locally(self._around, surprise, seen))
            seen &= apart <= room + max(options.neighbour_tolerance, 4.0 * _share(apart[seen], 0.5))
        return seen & ~torn_off(self._around, found.pixels, guess, seen)

    def _gate(self, far: Float[np.ndarray, " some"]) -> Float[np.ndarray, " nodes"]:
        """Most distance [px] of each node from what is expected: wide where innovations scatter, below half a pitch."""
        scatter = max(self._scatter, _share(far, MOST))
        wide = max(self.options.gate_least, self.options.gate_factor * scatter)
        return np.minimum(wide, 0.45 * self._around.pitch)

    # ---------------------------------------------------------------------------------------------- bookkeeping

    def _accept(
        self, view: View, guess: Any, predicted: Any, found: Alignment, seen: Bool[np.ndarray, " nodes"]
    ) -> Tracks:
        last = self._view
        assert last is not None
        estimate = guess.copy()
        if seen.any():
            estimate = self._filled(found, seen, predicted)
            far = _share(_length(found.pixels - guess)[seen], MOST)
            self._scatter = max(far, DAMPING * self._scatter)
        self._velocity = (estimate - last.pixels) / (self._blind_frames + 1)
        if predicted is not None:
            self._innovation = estimate - predicted if seen.any() else DAMPING * self._innovation
        self._blind_frames = 0
        self._lost_frames = self._lost_frames + 1 if seen.mean() < FEW else 0
        self._pixels = view.pixels = estimate
        view.seen = seen
        self._view = view
        shown = estimate if predicted is None else np.where(seen[:, None], found.pixels, predicted)
        usual = _share(found.score[self._fine.usable], 0.75)
        if seen.mean() > FEW:
            habit = np.minimum(found.score / max(usual, 1e-6), 1.0)
            self._habit = np.where(seen, self._habit + HABIT * (habit - self._habit), self._habit)
        error = np.where(seen, found.error, np.inf)
        return Tracks(shown.copy(), seen, error, np.where(seen, found.score, 0.0), FrameQuality.good)

    def _blind(self, guess: Any, predicted: Any, quality: FrameQuality) -> Tracks:
        """A frame in which nothing is seen: everything goes on as expected."""
        self._blind_frames += 1
        self._lost_frames += 1
        self._pixels = guess
        if self._blind_frames > PATIENCE:
            self._velocity = DAMPING * self._velocity
        nodes = len(guess)
        shown = guess if predicted is None else predicted
        return Tracks(
            np.array(shown, np.float64), np.zeros(nodes, bool), np.full(nodes, np.inf), np.zeros(nodes), quality
        )


def _share(values: Float[np.ndarray, " some"], share: float) -> float:
    """The value below which a share of the values lies; the nearest of them, without numpy's tenth of a millisecond."""
    place = min(int(share * len(values)), len(values) - 1)
    return float(np.partition(values, place)[place])


def _length(vectors: Float[np.ndarray, "nodes 2"]) -> Float[np.ndarray, " nodes"]:
    return np.hypot(vectors[:, 0], vectors[:, 1])
