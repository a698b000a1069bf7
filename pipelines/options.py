"""Options of the frame itself; those of the rooms lie in the rooms."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

from zsdt.perception.calibration import BoardOptions
from zsdt.perception.segmentation import SegmentationBackend
from zsdt.twin.glass_loop import GlassTwinOptions
from zsdt.twin.glass_overlay import GlassOverlayOptions
from zsdt.twin.loop import TwinOptions
from zsdt.twin.overlay import OverlayOptions


class Baseline(Enum):
    """A method that needs no training.

    static: a picture in which nothing moves. inertia: straight flight. fem_5cm, fem_10cm: the ground truth of a beam
    on a coarser mesh. full_sph, coarse_sph, coarser_sph: the ground truth of a liquid with 1, 1.5 and 2 times the
    spacing, from particles of its own.
    """

    static = "static"
    inertia = "inertia"
    fem_5cm = "fem_5cm"
    fem_10cm = "fem_10cm"
    full_sph = "full_sph"
    coarse_sph = "coarse_sph"
    coarser_sph = "coarser_sph"


class Weights(Enum):
    """Whose weights a twin uses: those that come with the package, or those that this experiment trains."""

    shipped = "shipped"
    trained = "trained"


@dataclass
class TwinParts:
    """Whose weights each part of a twin has."""

    vision: Weights = Weights.shipped
    psi_ini: Weights = Weights.shipped
    tignn: Weights = Weights.shipped


class FirstStress(Enum):
    """What the stress in the first frame is: psi_ini, inferred by that network, or own_rest, that of the engine's own
    rest, which its calibration on the first frame finds anyway."""

    psi_ini = "psi_ini"
    own_rest = "own_rest"


@dataclass
class Watching:
    """A twin in front of a video.

    video: a file, a folder of pictures, or the number of a webcam; null: clip number `clip` of the virtual lab.
    camera: file of a calibrated camera (stage calibrate_camera), or focal_px for one without distortion whose centre
    is the picture's. weights. backend: of the segmentation. compare_open: an open loop beside the closed one.
    recording: a file for the Rerun viewer. plan: graph, cadence and segmentation are chosen by the budget (see
    `zsdt.planning`); only the fields that the scene wants are decoded and drawn, and no open loop runs beside.
    """

    video: str | None = None
    clip: int = 0
    camera: str | None = None
    focal_px: float | None = None
    weights: TwinParts = field(default_factory=TwinParts)
    backend: SegmentationBackend = SegmentationBackend.fastest
    compare_open: bool = True
    recording: bool = True
    plan: bool = False


@dataclass
class TwinRun(Watching):
    """A twin of a beam in front of a video. first_stress. loop, overlay: see `zsdt.twin`."""

    first_stress: FirstStress = FirstStress.psi_ini
    loop: TwinOptions = field(default_factory=TwinOptions)
    overlay: OverlayOptions = field(default_factory=OverlayOptions)


@dataclass
class GlassTwinRun(Watching):
    """A twin of a liquid in a glass in front of a video.

    Where a camera stands that knows only its lens: distance [m] on the table from the axis of the glass, height [m]
    above the table, tilt_deg downwards. loop, overlay: see `zsdt.twin`.
    """

    distance: float = 0.6
    height: float = 0.12
    tilt_deg: float = 6.0
    loop: GlassTwinOptions = field(default_factory=GlassTwinOptions)
    overlay: GlassOverlayOptions = field(default_factory=GlassOverlayOptions)


@dataclass
class CameraCalibration:
    """images: folder of pictures of the board; null where nothing is calibrated. board: see `zsdt.perception`."""

    images: str | None = None
    board: BoardOptions = field(default_factory=BoardOptions)
