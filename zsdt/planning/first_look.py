"""How large a beam is, from the first picture that shows its grid: what a plan needs before the twin begins."""

from __future__ import annotations

from zsdt.errors import DataError
from zsdt.perception.grid_graph import extract_grid
from zsdt.perception.segmentation import Segmenter
from zsdt.perception.video import FrameSource
from zsdt.twin.loop import TwinOptions
from zsdt.twin.twin_scene import BeamTwinScene


def seen_size(
    source: FrameSource, segmenter: Segmenter, scene: BeamTwinScene, options: TwinOptions
) -> tuple[float, float]:
    """Length and height [m] of the beam, as the painted grid counts them.

    Raises: DataError where none of the first pictures shows a grid.
    """
    reason: DataError | None = None
    for tried, frame in enumerate(source, 1):
        try:
            grid = extract_grid(segmenter.probability(frame.image), frame.image, options.grid)
            return (grid.columns - 1) * scene.pitch, (grid.rows - 1) * scene.pitch
        except DataError as error:
            reason = error
        if tried >= options.search:
            break
    raise reason or DataError(f"{source.name} holds no frame; check the file.")
