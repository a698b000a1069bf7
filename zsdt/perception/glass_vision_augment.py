"""Windows on labelled glasses as the twin cuts them out, by other cameras, under other lamps, behind hands."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsdt.errors import OptionError
from zsdt.perception.glass_vision_data import LabelledGlasses
from zsdt.perception.glass_vision_texture import retextured
from zsdt.perception.glass_window import OUTSIDE, box_of, boxes_of
from zsdt.perception.segmentation import normalised


@dataclass
class GlassAugmentation:
    """Ranges of what is drawn for every window.

    near: side of a window as multiples of the container's longer side, as the region of interest cuts it; wide: the
    same where the glass is still searched for, drawn for a share `search`. shift: of the window, share of what it
    shows beside the glass. rotation [degrees], stretch (width against height). flip: share mirrored left to right.
    permute, grey: shares with permuted or without colours. contrast, gamma, brightness, tint: largest change. blur,
    motion [px] along the picture, noise (of white), jpeg: lowest quality. texture: share with a
    strange pattern (see `zsdt.perception.glass_vision_texture`). occlude: share behind a hand or a bar.
    beside: share with part of another picture, glass included, at a side.
    """

    near_low: float = 1.1
    near_high: float = 1.9
    wide_high: float = 4.0
    search: float = 0.25
    shift: float = 1.0
    rotation: float = 5.0
    stretch: float = 0.12
    flip: float = 0.5
    permute: float = 0.3
    grey: float = 0.1
    contrast: float = 0.35
    gamma: float = 0.3
    brightness: float = 0.15
    tint: float = 0.1
    blur: float = 1.0
    motion: float = 5.0
    noise: float = 0.03
    jpeg: int = 35
    texture: float = 0.4
    occlude: float = 0.15
    beside: float = 0.1

    def __post_init__(self) -> None:
        if not 0 < self.near_low <= self.near_high <= self.wide_high:
            raise OptionError("near_low, near_high and wide_high must be above 0 and in this order.")
        ranges = (self.rotation, self.contrast, self.gamma, self.brightness, self.tint, self.blur, self.motion)
        if min(*ranges, self.noise, self.shift) < 0 or not 0 <= self.stretch < 0.5:
            raise OptionError("Ranges of the augmentation must not be negative, and stretch below 0.5.")
        shares = (self.search, self.flip, self.permute, self.grey, self.texture, self.occlude, self.beside)
        if not all(0 <= share <= 1 for share in shares) or not 1 <= self.jpeg <= 100:
            raise OptionError(
                "search, flip, permute, grey, texture, occlude and beside are shares, 0..1; jpeg within 1..100."
            )


Sample = tuple[Float[np.ndarray, "size size 3"], Float[np.ndarray, "2 size size"], Float[np.ndarray, "size size"]]


def random_window(
    data: LabelledGlasses, number: int, size: int, options: GlassAugmentation, rng: np.random.Generator
) -> Sample:
    """A changed window of a picture: values -0.5..0.5, shares of container and liquid, and what of it counts.

    What lies beyond the border of the picture counts nothing.
    """
    image, container, liquid, valid = _warped(data, number, size, options, rng)
    if rng.random() < options.beside:
        other = int(rng.integers(len(data)))
        if data.liquid_known[other] == data.liquid_known[number]:
            layers = (image, container, liquid, valid)
            _put_beside(layers, _warped(data, other, size, options, rng), rng)
    if rng.random() < options.texture:
        image = retextured(image, container, liquid, rng)
    if rng.random() < options.occlude:
        _hide(image, container, liquid, rng)
    image = _as_filmed(image, options, rng)
    image[valid < 128] = OUTSIDE  # as a window is cut
    shown = normalised(image)
    shares = np.stack([container, liquid]).astype(np.float32) / 255
    return shown, shares, (valid > 127).astype(np.float32)


def _warped(
    data: LabelledGlasses, number: int, size: int, options: GlassAugmentation, rng: np.random.Generator
) -> list[np.ndarray]:
    """Picture, container, liquid and what lies in the picture, of a random window."""
    image, container, liquid = data.images[number], data.containers[number], data.liquids[number]
    h, w = container.shape
    boxes = boxes_of(container > 127)
    if not boxes:  # no glass: any part of the picture
        side = float(rng.uniform(0.5, 1.2)) * max(h, w)
        middle = rng.uniform(0.25, 0.75, 2) * (w, h)
    else:
        box = boxes[int(rng.integers(len(boxes)))]
        low, high = options.near_low, options.near_high
        if rng.random() < options.search:
            low, high = options.near_high, options.wide_high
        side = box.extent * float(np.exp(rng.uniform(np.log(low), np.log(high))))
        side = max(min(side, 1.1 * max(h, w)), options.near_low * box.extent)
        spare = 0.5 * (side - np.array([box.right - box.left, box.bottom - box.top]) * 0.85)
        middle = np.array(box.middle) + options.shift * spare * rng.uniform(-1, 1, 2)
        # Windows of the twin reach beyond the picture only where a glass is near its border.
        reach = 0.5 * side * (1 - float(rng.choice([0.05, 0.5], p=[0.8, 0.2])))
        middle = np.where(2 * reach < np.array([w, h]), np.clip(middle, reach, np.array([w, h]) - reach), middle)
    angle = np.deg2rad(rng.uniform(-options.rotation, options.rotation))
    wider = float(np.exp(rng.uniform(-options.stretch, options.stretch)))
    mirror = -1.0 if rng.random() < options.flip else 1.0
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    to_source = turn @ np.diag([mirror * wider, 1 / wider]) * (side / size)
    matrix = np.concatenate([to_source, (middle - to_source @ np.full(2, (size - 1) / 2))[:, None]], axis=1)
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    layers = [image, container, liquid, np.full((h, w), 255, np.uint8)]
    if side > 1.2 * size:  # shrinking averages, as the cut of a window does
        layers = [cv2.GaussianBlur(layer, (0, 0), 0.4 * side / size) for layer in layers[:3]] + layers[3:]
    fills = [(OUTSIDE,) * 3, (0,), (0,), (0,)]
    return [
        np.asarray(cv2.warpAffine(layer, matrix, (size, size), flags=how, borderValue=fill), np.uint8)
        for layer, fill in zip(layers, fills, strict=True)
    ]


def _put_beside(layers: tuple[np.ndarray, ...], others: list[np.ndarray], rng: np.random.Generator) -> None:
    """Replaces a strip at a side that shows nothing of the glass by a strip of another picture."""
    size = layers[0].shape[1]
    box = box_of(layers[1] > 8)
    left, right = (size // 3, size - size // 3) if box is None else (box.left, box.right)
    if rng.random() < 0.5:
        strip = np.s_[:, : max(0, left - int(rng.integers(2, 12)))]
    else:
        strip = np.s_[:, min(size, right + int(rng.integers(2, 12))) :]
    for layer, other in zip(layers, others, strict=True):
        layer[strip] = other[strip]


def _hide(image: np.ndarray, container: np.ndarray, liquid: np.ndarray, rng: np.random.Generator) -> None:
    """Draws something in front, of skin or of any colour: a hand with fingers from a side, or a bar. No glass there."""
    size = len(container)
    shape = np.zeros((size, size), np.uint8)
    start = np.array([rng.choice([-0.05, 1.05]), rng.uniform(0.0, 1.0)]) * size
    if rng.random() < 0.3:
        start = start[::-1].copy()
    tip = rng.uniform(0.2, 0.8, 2) * size
    thick = rng.uniform(0.05, 0.18) * size
    cv2.line(shape, _point(start), _point(tip), 255, max(1, int(thick)))
    for _ in range(int(rng.integers(0, 5))):
        end = tip + rng.normal(0, 0.16, 2) * size
        cv2.line(shape, _point(tip), _point(end), 255, max(1, int(thick * rng.uniform(0.25, 0.5))))
    shape = np.asarray(cv2.GaussianBlur(shape, (0, 0), 1.2), np.uint8)
    if rng.random() < 0.5:
        colour = np.array([0.55, 0.68, 0.9]) * rng.uniform(90, 250) * rng.uniform(0.9, 1.1, 3)  # skin, BGR
    else:
        colour = rng.uniform(10, 245, 3)
    shade = cv2.resize(rng.uniform(0.75, 1.2, (5, 5)), (size, size), interpolation=cv2.INTER_CUBIC)
    cover = shape[..., None].astype(np.float32) / 255
    painted = np.clip(colour * shade[..., None], 0, 255)
    image[:] = np.rint(image * (1 - cover) + painted * cover).astype(np.uint8)
    for mask in (container, liquid):
        mask[:] = np.rint(mask * (1 - cover[..., 0])).astype(np.uint8)


def _point(place: np.ndarray) -> tuple[int, int]:
    return round(float(place[0])), round(float(place[1]))


def _as_filmed(
    image: UInt8[np.ndarray, "h w 3"], options: GlassAugmentation, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"]:
    """Other light, colours, sharpness, noise and compression."""
    if rng.random() < options.permute:
        image = np.ascontiguousarray(image[..., rng.permutation(3)])
    if rng.random() < options.grey:
        image = np.asarray(cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR), np.uint8)
    sigma = rng.uniform(0, options.blur)
    if sigma > 0.2:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.uint8)
    length = int(rng.uniform(0, options.motion))
    if length > 1 and rng.random() < 0.4:
        image = np.asarray(cv2.blur(image, (length, 1)), np.uint8)
    gamma = np.exp(rng.uniform(-options.gamma, options.gamma))
    gain = rng.uniform(1 - options.contrast, 1 + options.contrast)
    lift = rng.uniform(-options.brightness, options.brightness) + rng.uniform(-options.tint, options.tint, 3)
    curve = ((np.arange(256) / 255) ** gamma - 0.5)[:, None] * gain + 0.5 + lift  # [grey level, channel]
    levels = np.asarray(cv2.LUT(image, (255 * curve).astype(np.float32)[None]), np.float32)
    levels += np.float32(255 * rng.uniform(0, options.noise)) * rng.standard_normal(levels.shape, dtype=np.float32)
    filmed = np.rint(np.clip(levels, 0, 255)).astype(np.uint8)
    if rng.random() < 0.4:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.uniform(options.jpeg, 100))]
        filmed = np.asarray(cv2.imdecode(cv2.imencode(".jpg", filmed, quality)[1], cv2.IMREAD_COLOR), np.uint8)
    return filmed
