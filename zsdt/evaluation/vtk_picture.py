"""Exported VTKHDF files as VTK draws them, without a window: what somebody sees who opens them in ParaView.

Needs the optional package vtk.
"""

from __future__ import annotations

import importlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zsdt.errors import OptionError
from zsdt.files import atomic_path

LEGEND = 150  # px: width of the column with the colour bars
_MODULES = (
    "vtkCommonCore",
    "vtkFiltersGeometry",
    "vtkFiltersSources",
    "vtkFiltersCore",
    "vtkIOHDF",
    "vtkIOImage",
    "vtkRenderingAnnotation",
    "vtkRenderingCore",
    "vtkRenderingFreeType",
    "vtkRenderingOpenGL2",
)


@dataclass(frozen=True)
class Shot:
    """A row of a picture: the file, the field that colours it, its title, limits of the colours, frames to show.

    particle: radius of the spheres [m] that vertices are drawn as, None for cells. vessel: a file that is drawn as
    glass around them. view: direction from which the camera looks.
    """

    path: Path
    field: str
    title: str
    limits: tuple[float, float]
    frames: tuple[int, ...]
    particle: float | None = None
    vessel: Path | None = None
    view: tuple[float, float, float] = (0.35, -1.0, 0.35)


def _vtk() -> Any:
    """The names of VTK that a picture needs. Raises: OptionError where it is not installed."""
    found: dict[str, Any] = {}
    try:
        for name in _MODULES:
            found |= vars(importlib.import_module(f"vtkmodules.{name}"))
    except ImportError as error:
        raise OptionError(
            "Pictures of VTKHDF files need the package vtk, which is not installed; run `pip install 'zsdt[vtk]'`."
        ) from error
    return type("Vtk", (), found)


def draw(path: str | os.PathLike[str], shots: list[Shot], cell: tuple[int, int] = (520, 360)) -> None:
    """Writes a PNG with a row for each shot and a column for each of its frames; `cell` [px] is the size of one.

    Raises: OptionError where vtk is not installed; DataError where the disk does not take the file.
    """
    vtk = _vtk()
    columns = max(len(shot.frames) for shot in shots)
    width = columns * cell[0] + LEGEND
    window = vtk.vtkRenderWindow()
    window.SetOffScreenRendering(1)
    window.SetMultiSamples(8)
    window.SetSize(width, len(shots) * cell[1])
    for row, shot in enumerate(shots):
        first = None
        colours = _colours(vtk, shot.limits)
        bottom, top = 1.0 - (row + 1) / len(shots), 1.0 - row / len(shots)
        for column, frame in enumerate(shot.frames):
            renderer = _rendered(vtk, shot, frame, colours)
            renderer.SetViewport(column * cell[0] / width, bottom, (column + 1) * cell[0] / width, top)
            if first is None:
                first = renderer.GetActiveCamera()  # the same view in every column
            renderer.SetActiveCamera(first)
            window.AddRenderer(renderer)
        beside = vtk.vtkRenderer()
        beside.SetBackground(1.0, 1.0, 1.0)
        beside.SetViewport(1.0 - LEGEND / width, bottom, 1.0, top)
        beside.AddViewProp(_legend(vtk, colours, shot.title))
        window.AddRenderer(beside)
    window.Render()
    taken = vtk.vtkWindowToImageFilter()
    taken.SetInput(window)
    taken.ReadFrontBufferOff()
    writer = vtk.vtkPNGWriter()
    with atomic_path(path) as target:
        writer.SetFileName(os.fspath(target))
        writer.SetInputConnection(taken.GetOutputPort())
        writer.Write()


def _rendered(vtk: Any, shot: Shot, frame: int, colours: Any) -> Any:
    """One frame of a shot."""
    reader = vtk.vtkHDFReader()
    reader.SetFileName(os.fspath(shot.path))
    reader.UpdateInformation()
    key = reader.GetExecutive().TIME_STEPS()
    time = reader.GetOutputInformation(0).Get(key, frame)
    reader.UpdateTimeStep(time)
    mapper = vtk.vtkPolyDataMapper()
    if shot.particle is not None:
        ball = vtk.vtkSphereSource()
        ball.SetRadius(shot.particle)
        ball.SetThetaResolution(14)
        ball.SetPhiResolution(14)
        mapper = vtk.vtkGlyph3DMapper()
        mapper.SetSourceConnection(ball.GetOutputPort())
        mapper.SetInputConnection(reader.GetOutputPort())
        mapper.ScalingOff()
    else:
        skin = vtk.vtkGeometryFilter()
        skin.SetInputConnection(reader.GetOutputPort())
        mapper.SetInputConnection(skin.GetOutputPort())
    mapper.SetScalarModeToUsePointFieldData()
    mapper.SelectColorArray(shot.field)
    mapper.SetLookupTable(colours)
    mapper.UseLookupTableScalarRangeOn()
    body = vtk.vtkActor()
    body.SetMapper(mapper)
    body.GetProperty().SetAmbient(0.35)
    body.GetProperty().SetDiffuse(0.70)
    if shot.particle is None:
        body.GetProperty().EdgeVisibilityOn()
        body.GetProperty().SetEdgeColor(0.25, 0.25, 0.25)
    renderer = vtk.vtkRenderer()
    renderer.SetBackground(1.0, 1.0, 1.0)
    renderer.AddActor(body)
    if shot.vessel is not None:
        renderer.AddActor(_glass(vtk, shot.vessel))
    renderer.AddViewProp(_text(vtk, f"{shot.title.partition(' [')[0]}, {time:.3f} s"))
    camera = renderer.GetActiveCamera()
    camera.SetViewUp(0.0, 0.0, 1.0)
    camera.SetPosition(*shot.view)
    camera.SetFocalPoint(0.0, 0.0, 0.0)
    renderer.ResetCamera()
    camera.Zoom(1.1 if shot.vessel is None else 1.0)
    return renderer


def _colours(vtk: Any, limits: tuple[float, float]) -> Any:
    """Blue over white to red where the limits have both signs, black over red to yellow where not."""
    table = vtk.vtkColorTransferFunction()
    low, high = limits
    stops = [(low, (0.08, 0.09, 0.30)), ((low + high) / 2, (0.75, 0.22, 0.33)), (high, (0.98, 0.91, 0.45))]
    if low < 0.0 < high:
        stops = [(low, (0.13, 0.30, 0.62)), (0.0, (0.95, 0.95, 0.95)), (high, (0.70, 0.09, 0.17))]
    for value, colour in stops:
        table.AddRGBPoint(value, *colour)
    return table


def _glass(vtk: Any, path: Path) -> Any:
    reader = vtk.vtkHDFReader()
    reader.SetFileName(os.fspath(path))
    mapper = vtk.vtkPolyDataMapper()
    mapper.SetInputConnection(reader.GetOutputPort())
    actor = vtk.vtkActor()
    actor.SetMapper(mapper)
    actor.GetProperty().SetColor(0.55, 0.70, 0.80)
    actor.GetProperty().SetOpacity(0.18)
    return actor


def _text(vtk: Any, words: str) -> Any:
    text = vtk.vtkTextActor()
    text.SetInput(words)
    text.SetPosition(14, 12)
    text.GetTextProperty().SetFontSize(20)
    text.GetTextProperty().SetColor(0.1, 0.1, 0.1)
    return text


def _legend(vtk: Any, colours: Any, title: str) -> Any:
    bar = vtk.vtkScalarBarActor()
    bar.SetLookupTable(colours)
    bar.SetTitle(title.replace(" [", "\n["))
    bar.SetNumberOfLabels(3)
    bar.SetLabelFormat("{:.4g}" if tuple(map(int, vtk.vtkVersion.GetVTKVersion().split(".")[:2])) >= (9, 6) else "%.4g")
    bar.SetUnconstrainedFontSize(True)
    for words in (bar.GetTitleTextProperty(), bar.GetLabelTextProperty()):
        words.SetFontSize(15)
        words.SetColor(0.1, 0.1, 0.1)
        words.ItalicOff()
        words.BoldOff()
        words.ShadowOff()
    bar.SetPosition(0.10, 0.12)
    bar.SetWidth(0.85)
    bar.SetHeight(0.76)
    bar.SetBarRatio(0.25)
    return bar
