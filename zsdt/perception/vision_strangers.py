"""Strange patterns behind the beam, and other pens and foams, so that neither lines nor colours alone tell the grid.

A room is full of grids: tiles, shelves, fences, writing. A few kinds in the training pictures do not teach that *any*
pattern beside the painted face is to be ignored, so that crops get random ones: lattices of any two directions and
spacings, with or without stagger, framed boards of a few fields, curves, and grains of any size. All is drawn from
ranges; no particular wall is copied.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import binary_fill_holes

CONTRAST = 60.0  # grey levels, in some channel, between foam and paint


def face_of(mask: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """The painted face, 255, from its grid lines: all that they enclose, and they themselves."""
    painted = cv2.dilate((mask > 64).astype(np.uint8), np.ones((3, 3), np.uint8))
    return np.where(binary_fill_holes(painted), 255, 0).astype(np.uint8)


def with_strangers(
    crop: UInt8[np.ndarray, "size size 3"], face: UInt8[np.ndarray, "size size"], rng: np.random.Generator
) -> UInt8[np.ndarray, "size size 3"]:
    """The crop with one to four strange patterns where the face is not."""
    behind = crop.astype(np.float32)
    for _ in range(rng.integers(1, 5)):
        where = _patch(crop.shape[0], rng)
        kind = rng.choice(4, p=(0.15, 0.4, 0.3, 0.15))
        if kind == 0:
            behind[where] = _grain(behind, rng)[where]
        elif kind == 1:
            behind = _lattice(behind, where, rng)
        elif kind == 2:
            _board(behind, rng)
        else:
            _curve(behind, rng)
    blur = rng.uniform(0.0, 1.5)
    if blur > 0.3:
        behind = np.asarray(cv2.GaussianBlur(behind, (0, 0), blur), np.float32)
    share = face[..., None].astype(np.float32) / 255
    return np.clip(crop * share + behind * (1 - share), 0, 255).astype(np.uint8)


def repainted(
    crop: UInt8[np.ndarray, "size size 3"],
    paint: UInt8[np.ndarray, "size size"],
    face: UInt8[np.ndarray, "size size"],
    rng: np.random.Generator,
) -> UInt8[np.ndarray, "size size 3"]:
    """The crop with foam and paint of other colours that can be told apart, their texture kept.

    Colours are shifted in proportion to how much of a pixel is paint and how much is foam. A crop that shows too little
    of either stays as it is.
    """
    lines, foam = paint > 200, (face > 200) & (paint < 30)
    if lines.sum() < 50 or foam.sum() < 200:
        return crop
    new_foam = _colour(rng)
    new_paint = _colour(rng)
    while np.abs(new_paint - new_foam).max() < CONTRAST:
        new_paint = _colour(rng)
    share = paint[..., None].astype(np.float32) / 255
    rest = np.maximum(face[..., None].astype(np.float32) / 255 - share, 0)
    shift = share * (new_paint - crop[lines].mean(axis=0)) + rest * (new_foam - crop[foam].mean(axis=0))
    return np.clip(crop + shift, 0, 255).astype(np.uint8)


def _colour(rng: np.random.Generator) -> Float[np.ndarray, "3"]:
    """Grey with a cast, or any colour."""
    if rng.random() < 0.5:
        return np.clip(rng.uniform(20, 235) + rng.normal(0, 15, 3), 0, 255).astype(np.float32)
    return rng.uniform(0, 255, 3).astype(np.float32)


def _patch(size: int, rng: np.random.Generator) -> Bool[np.ndarray, "size size"]:
    """A turned rectangle somewhere in the crop, or all of it."""
    if rng.random() < 0.4:
        return np.ones((size, size), bool)
    box = (tuple(rng.uniform(0, size, 2)), tuple(rng.uniform(0.25, 1.0, 2) * size), rng.normal(0, 15))
    canvas = np.zeros((size, size), np.uint8)
    cv2.fillPoly(canvas, [np.rint(cv2.boxPoints(box)).astype(np.int32)], 1)
    return canvas > 0


def _lattice(
    behind: Float[np.ndarray, "size size 3"], where: Bool[np.ndarray, "size size"], rng: np.random.Generator
) -> Float[np.ndarray, "size size 3"]:
    """Two families of parallel lines, the second perhaps staggered from row to row, on the ground or on a board."""
    size = behind.shape[0]
    v, u = np.mgrid[0:size, 0:size].astype(np.float32)
    first = rng.normal(0, 0.15) if rng.random() < 0.6 else rng.uniform(0, np.pi)
    second = first + np.pi / 2 + (0.0 if rng.random() < 0.6 else rng.uniform(-0.7, 0.7))
    spacing = np.exp(rng.uniform(np.log(10), np.log(90), 2))
    width = np.exp(rng.uniform(np.log(1.0), np.log(9.0)))
    p = np.cos(first) * v - np.sin(first) * u + rng.uniform(0, spacing[0])
    q = np.cos(second) * v - np.sin(second) * u + rng.uniform(0, spacing[1])
    row = np.floor(p / spacing[0])
    stagger = rng.choice([0.0, 0.0, 0.5, rng.uniform(0.1, 0.5)])
    q = q + stagger * spacing[1] * row
    lines = _line(p, spacing[0], width)
    if rng.random() < 0.85:
        lines = np.maximum(lines, _line(q, spacing[1], width))
    share = np.where(where, lines, 0)[..., None] * np.float32(rng.uniform(0.5, 1.0))
    if rng.random() < 0.6:  # a board, its fields of one colour or of several like ones
        fields = 1.0 + rng.uniform(0, 0.2) * np.sin(12.9898 * row + 78.233 * np.floor(q / spacing[1]))
        behind = np.where(where[..., None], _colour(rng) * fields[..., None], behind)
    return np.asarray(behind * (1 - share) + _colour(rng) * share, np.float32)


def _board(behind: Float[np.ndarray, "size size 3"], rng: np.random.Generator) -> None:
    """Draws a framed board of a few equal fields, like a window, a shelf or a rack."""
    fields = rng.integers(1, 8, 2)
    step = np.exp(rng.uniform(np.log(10), np.log(60))) * np.array([1.0, rng.choice([1.0, rng.uniform(0.5, 2.0)])])
    turn = rng.normal(0, 0.08) + np.pi / 2 * rng.integers(2)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    corner = rng.uniform(-0.2, 1.0, 2) * behind.shape[0]

    def place(i: int, j: int) -> np.ndarray:
        return np.rint((corner + i * step[0] * axes[0] + j * step[1] * axes[1]) * 16).astype(np.int32)

    m, n = (int(f) for f in fields)
    if rng.random() < 0.8:
        cv2.fillPoly(
            behind, [np.array([place(0, 0), place(m, 0), place(m, n), place(0, n)])], _bgr(rng), cv2.LINE_AA, 4
        )
    ink, width = _bgr(rng), int(rng.integers(1, 9))
    ends = [(place(k, 0), place(k, n)) for k in range(m + 1)] + [(place(0, k), place(m, k)) for k in range(n + 1)]
    for a, b in ends:
        cv2.line(behind, (int(a[0]), int(a[1])), (int(b[0]), int(b[1])), ink, width, cv2.LINE_AA, 4)


def _curve(behind: Float[np.ndarray, "size size 3"], rng: np.random.Generator) -> None:
    """Draws a smooth curve, like a cable."""
    t = np.linspace(0, 1, 30)[:, None]
    a, b, c = rng.uniform(-0.2, 1.2, (3, 2)) * behind.shape[0]
    curve = (1 - t) ** 2 * a + 2 * t * (1 - t) * b + t**2 * c
    points = np.rint(curve * 16).astype(np.int32)
    cv2.polylines(behind, [points], False, _bgr(rng), int(rng.integers(1, 9)), cv2.LINE_AA, 4)


def _bgr(rng: np.random.Generator) -> tuple[float, ...]:
    return tuple(float(c) for c in _colour(rng))


def _line(along: Float[np.ndarray, "size size"], spacing: float, width: float) -> Float[np.ndarray, "size size"]:
    """Cover of lines of `width` px every `spacing` px."""
    away = np.abs((along + spacing / 2) % spacing - spacing / 2)
    return np.clip(width / 2 - away + 0.5, 0, 1)


def _grain(behind: Float[np.ndarray, "size size 3"], rng: np.random.Generator) -> Float[np.ndarray, "size size 3"]:
    """Stains of any size, soft or sharp."""
    size = behind.shape[0]
    cells = int(np.exp(rng.uniform(np.log(4), np.log(size / 3))))
    noise = cv2.resize(rng.standard_normal((cells, cells)).astype(np.float32), (size, size))
    if rng.random() < 0.5:
        noise = np.where(noise > rng.uniform(-0.5, 1.2), 1.0, -0.2).astype(np.float32)
    return np.asarray(_colour(rng) * (1.0 + rng.uniform(0.05, 0.4) * noise)[..., None], np.float32)
