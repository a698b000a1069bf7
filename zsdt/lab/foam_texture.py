"""The surface of a foam beam as a picture in material coordinates: pores, stains and the painted grid."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsdt.lab.styles import Style

MARGIN = 6  # transparent pixels around a face; interpolation over them gives the soft edge of the silhouette


@dataclass(frozen=True)
class FaceTexture:
    """A face of the beam, row 0 at its bottom.

    colour [height, width, 4]: BGR and cover (255 on the face, 0 around it); lines [height, width]: cover of the
    painted lines; scale: texture pixels per m. Material point (u, v) [m] is at pixel (u, v) * scale + MARGIN.
    """

    colour: UInt8[np.ndarray, "height width 4"]
    lines: UInt8[np.ndarray, "height width"]
    scale: float


def value_noise(
    rng: np.random.Generator, height: int, width: int, cells: tuple[int, ...]
) -> Float[np.ndarray, "height width"]:
    """Smooth random field, float32, of standard deviation near 1: sum of octaves with `cells` over the height."""
    total = np.zeros((height, width), np.float32)
    for count in cells:
        grid = rng.standard_normal((count, max(2, count * width // height)), dtype=np.float32)
        total += cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
    return total / np.float32(np.sqrt(0.6 * len(cells)))


def foam(
    rng: np.random.Generator, style: Style, height: int, width: int, scale: float
) -> Float[np.ndarray, "height width 3"]:
    """Bare foam: stains, cells of the foam and pores; brightness 0 to 255, float32."""
    fine = max(8, round(height / scale / 0.004))  # grain of 4 mm
    shade = 1.0 + style.blotch * value_noise(rng, height, width, (3, 7))
    shade += 0.045 * value_noise(rng, height, width, (fine, 2 * fine))
    # Pores: points of 1 to 3 mm, drawn small and grown, as many as the style's share of the surface asks for.
    small = (max(2, round(height / scale / 0.0012)), max(2, round(width / scale / 0.0012)))
    points = (rng.random(small, dtype=np.float32) < style.pores).astype(np.float32)
    deep = cv2.GaussianBlur(cv2.resize(points, (width, height), interpolation=cv2.INTER_LINEAR), (0, 0), 0.7)
    shade *= 1.0 - 0.6 * np.clip(1.6 * deep, 0.0, 1.0)
    return np.asarray(style.foam, np.float32) * shade[..., None]


def face_texture(
    rng: np.random.Generator, style: Style, columns: int, rows: int, pitch: float, scale: float
) -> FaceTexture:
    """The visible face with a grid of `columns` x `rows` crossings, `pitch` [m] apart, at `scale` pixels per m.

    scale * pitch must be whole: crossings then lie on texture pixels.
    """
    width = round((columns - 1) * pitch * scale) + 1 + 2 * MARGIN
    height = round((rows - 1) * pitch * scale) + 1 + 2 * MARGIN
    lines = np.zeros((height, width), np.float32)
    for k in range(columns):
        _draw_line(rng, style, lines, k * pitch, rows, pitch, scale)
    across = np.zeros((width, height), np.float32)
    for k in range(rows):
        _draw_line(rng, style, across, k * pitch, columns, pitch, scale)
    lines = np.maximum(lines, across.T)
    cover: np.ndarray = lines
    if style.line_bleed * scale > 0.2:
        cover = cv2.GaussianBlur(lines, (0, 0), style.line_bleed * scale)
    cover = np.clip(cover * (1.0 - style.fading * np.abs(value_noise(rng, height, width, (24, 48)))), 0.0, 1.0)
    paint = cover[..., None]
    colour = foam(rng, style, height, width, scale) * (1.0 - paint) + np.asarray(style.line, np.float32) * paint
    return _pack(colour, lines, scale)


def plain_texture(rng: np.random.Generator, style: Style, long: float, wide: float, scale: float) -> FaceTexture:
    """A face without lines, `long` x `wide` [m]; it also covers the margin, so that no gap opens between two faces."""
    width, height = round(long * scale) + 1 + 2 * MARGIN, round(wide * scale) + 1 + 2 * MARGIN
    packed = _pack(foam(rng, style, height, width, scale), np.zeros((height, width), np.float32), scale)
    packed.colour[..., 3] = 255
    return packed


def _draw_line(
    rng: np.random.Generator, style: Style, lines: np.ndarray, place: float, crossings: int, pitch: float, scale: float
) -> None:
    """A line along the first axis of `lines` at `place` [m] of the second; between crossings it wobbles."""
    along = (np.arange(lines.shape[0]) - MARGIN) / (scale * pitch)  # in pitches
    cell = np.clip(along.astype(np.int64), 0, max(crossings - 2, 0))
    part = np.clip(along - cell, 0.0, 1.0)
    swing = rng.normal(0.0, style.line_wobble, (2, max(crossings - 1, 1)))
    wobble = swing[0, cell] * np.sin(np.pi * part) + swing[1, cell] * np.sin(2.0 * np.pi * part)
    center = (place + wobble) * scale + MARGIN
    slow = np.interp(along, np.linspace(0, crossings - 1, 2 * crossings), rng.uniform(0.85, 1.15, 2 * crossings))
    half = 0.5 * style.line_width * scale * slow
    first = max(int(center.min() - half.max()) - 2, 0)
    last = min(int(center.max() + half.max()) + 3, lines.shape[1])
    away = np.abs(np.arange(first, last) - center[:, None])
    strip = np.clip(half[:, None] - away + 0.5, 0.0, 1.0).astype(np.float32)
    np.maximum(lines[:, first:last], strip, out=lines[:, first:last])


def _pack(colour: np.ndarray, lines: np.ndarray, scale: float) -> FaceTexture:
    """To bytes, with the cover of the face beside the colour."""
    height, width = lines.shape
    packed = np.empty((height, width, 4), np.uint8)
    packed[..., :3] = np.clip(colour, 0.0, 255.0)
    packed[..., 3] = 0
    # Half on the border itself, so that interpolation puts the edge there and not half a pixel further out.
    packed[MARGIN : height - MARGIN, MARGIN : width - MARGIN, 3] = 128
    packed[MARGIN + 1 : height - MARGIN - 1, MARGIN + 1 : width - MARGIN - 1, 3] = 255
    return FaceTexture(packed, (255.0 * lines + 0.5).astype(np.uint8), scale)
