"""Crops of labelled pictures as other cameras, lamps and pens would have taken them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsdt.errors import OptionError
from zsdt.perception.segmentation import normalised
from zsdt.perception.vision_strangers import repainted, with_strangers


@dataclass
class Augmentation:
    """Ranges of what is drawn for every crop.

    scale_low, scale_high: size of the grid against the picture. on_lines: share of crops around a painted pixel.
    rotation [degrees], beside flips and quarter turns (turns). permute, invert: shares with permuted and inverted
    colours. contrast, brightness: largest change. tint: of each colour channel. blur [px] and noise (of white): most.
    strangers: share with strange patterns behind the face, repaint: share with other colours of foam and paint (see
    `zsdt.perception.vision_strangers`).
    """

    scale_low: float = 0.5
    scale_high: float = 1.3
    on_lines: float = 0.5
    rotation: float = 15.0
    turns: bool = True
    permute: float = 0.6
    invert: float = 0.15
    contrast: float = 0.4
    brightness: float = 0.15
    tint: float = 0.15
    blur: float = 0.8
    noise: float = 0.03
    strangers: float = 0.75
    repaint: float = 0.5

    def __post_init__(self) -> None:
        if not 0 < self.scale_low <= self.scale_high:
            raise OptionError("scale_low must be above 0 and not above scale_high.")
        if min(self.rotation, self.contrast, self.brightness, self.tint, self.blur, self.noise) < 0:
            raise OptionError("Ranges of the augmentation must not be negative.")
        if not all(
            0 <= share <= 1 for share in (self.on_lines, self.permute, self.invert, self.strangers, self.repaint)
        ):
            raise OptionError("on_lines, permute, invert, strangers and repaint are shares in 0..1.")


def random_crop(
    image: UInt8[np.ndarray, "h w 3"],
    mask: UInt8[np.ndarray, "h w"],
    face: UInt8[np.ndarray, "h w"],
    size: int,
    options: Augmentation,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "size size 3"], Float[np.ndarray, "size size"]]:
    """A changed square of `size` px: picture of values -0.5..0.5 and the painted share of each pixel.

    face: what belongs to the painted face (`zsdt.perception.vision_strangers.face_of`).
    """
    crop, paint, inside = _warped([image, mask, face], size, options, rng)
    if rng.random() < options.repaint:
        crop = repainted(crop, paint, inside, rng)
    if rng.random() < options.strangers:
        crop = with_strangers(crop, inside, rng)
    colours = normalised(crop) + np.float32(0.5)
    sigma = rng.uniform(0, options.blur)
    if sigma > 0.2:
        colours = np.asarray(cv2.GaussianBlur(colours, (0, 0), sigma), np.float32)
    if rng.random() < options.permute:
        colours = colours[..., rng.permutation(3)]
    if rng.random() < options.invert:
        colours = 1 - colours
    gain = rng.uniform(1 - options.contrast, 1 + options.contrast)
    lift = rng.uniform(-options.brightness, options.brightness) + rng.uniform(-options.tint, options.tint, 3)
    grain = rng.uniform(0, options.noise) * rng.standard_normal(colours.shape, dtype=np.float32)
    changed = (colours - 0.5) * gain + 0.5 + lift + grain
    return (np.clip(changed, 0, 1) - 0.5).astype(np.float32), paint.astype(np.float32) / 255


def _warped(
    layers: list[np.ndarray], size: int, options: Augmentation, rng: np.random.Generator
) -> list[UInt8[np.ndarray, "size size *channels"]]:
    """A scaled, turned and mirrored square of picture, mask and face; beyond the border they are mirrored."""
    mask = layers[1]
    h, w = mask.shape
    scale = float(np.exp(rng.uniform(np.log(options.scale_low), np.log(options.scale_high))))
    angle = np.deg2rad(rng.uniform(-options.rotation, options.rotation))
    flip = 1.0
    if options.turns:
        angle += np.pi / 2 * rng.integers(4)
        flip = rng.choice([-1.0, 1.0])
    middle = _middle(mask, size / scale, options.on_lines, rng)
    cos, sin = np.cos(angle) / scale, np.sin(angle) / scale
    to_source = np.array([[flip * cos, -flip * sin], [sin, cos]])
    matrix = np.concatenate([to_source, (middle - to_source @ np.full(2, (size - 1) / 2))[:, None]], axis=1)
    reach = int(np.ceil(size / scale * 0.72)) + 4
    left, top = max(0, int(middle[0]) - reach), max(0, int(middle[1]) - reach)
    window = np.s_[top : min(h, int(middle[1]) + reach), left : min(w, int(middle[0]) + reach)]
    matrix[:, 2] -= (left, top)
    parts = [layer[window] for layer in layers]
    if scale < 1:  # no line may fall between the pixels of a smaller picture
        parts = [cv2.GaussianBlur(part, (0, 0), 0.35 / scale) for part in parts]
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return [
        np.asarray(cv2.warpAffine(part, matrix, (size, size), flags=how, borderMode=cv2.BORDER_REFLECT_101), np.uint8)
        for part in parts
    ]


def _middle(mask: UInt8[np.ndarray, "h w"], extent: float, on_lines: float, rng: np.random.Generator) -> np.ndarray:
    """Centre (u, v) of a crop that covers `extent` px of the picture."""
    h, w = mask.shape
    if rng.random() < on_lines:
        v, u = np.nonzero(mask[::8, ::8] > 127)
        if len(u):
            k = rng.integers(len(u))
            return np.array([8.0 * u[k], 8.0 * v[k]]) + rng.uniform(-0.4, 0.4, 2) * extent
    margin = np.minimum(extent / 2, np.array([w, h]) / 2)
    return rng.uniform(margin, np.array([w, h]) - margin)
