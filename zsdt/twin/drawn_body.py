"""Bodies in a recording: coloured skin and sharp edges, frame by frame."""

from __future__ import annotations

import numpy as np
import rerun as rr
from jaxtyping import Float, Int, UInt8

from zsdt.twin.surface import Surface


def send_skin(
    stream: rr.RecordingStream,
    entity: str,
    index: list[rr.TimeColumn],
    surface: Surface,
    places: Float[np.ndarray, "frames vertices 3"],
    colours: UInt8[np.ndarray, "frames vertices 4"],
) -> None:
    """The skin of a body (Mesh3D): vertices [m] and their RGBA in every frame."""
    triangles = rr.Mesh3D.from_fields(triangle_indices=surface.triangles.astype(np.uint32))
    stream.log(entity, triangles, static=True)
    mesh = rr.Mesh3D.columns(
        vertex_positions=places.reshape(-1, 3).astype(np.float32), vertex_colors=colours.reshape(-1, 4)
    )
    stream.send_columns(entity, index, mesh.partition([len(surface.nodes)] * len(places)))


def send_edges(
    stream: rr.RecordingStream,
    entity: str,
    index: list[rr.TimeColumn],
    edges: Int[np.ndarray, "edges 2"],
    places: Float[np.ndarray, "frames vertices 3"],
    colour: tuple[int, int, int],
) -> None:
    """Sharp edges as line segments (LineStrips3D), a pixel and a half wide."""
    stream.log(entity, rr.LineStrips3D.from_fields(colors=[colour], radii=rr.Radius.ui_points(0.75)), static=True)
    strips = rr.LineStrips3D.columns(strips=places[:, edges].reshape(-1, 2, 3).astype(np.float32))
    stream.send_columns(entity, index, strips.partition([len(edges)] * len(places)))
