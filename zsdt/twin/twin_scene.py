"""What the beam twin is told about the scene before it sees the first frame."""

from __future__ import annotations

from dataclasses import dataclass, field

from zsdt.errors import OptionError
from zsdt.fields import FIELDS
from zsdt.perception.depth import DepthOptions
from zsdt.perception.grid_graph import ClampChoice
from zsdt.scene import Foam

DERIVED = ("von_mises",)


@dataclass
class BeamTwinScene:
    """A foam beam with a painted grid in front of one camera; length and height come from the picture.

    width [m]: of the beam into the picture, which no camera sees. pitch [m]: of the painted grid. material: the
    nominal card. gravity [m/s2] downwards. fps: frames per second, 0: what the video says. depth [m]: from the camera
    to the visible face along the optical axis; depth_maps replace it where they have values. fields: what is decoded
    in every frame (names of `zsdt.fields` and von_mises); nothing else is. planar: the beam moves in the plane of the
    picture and does not twist; else the twin also looks for sideways bending and torsion, which one camera sees in the
    perspective (and a depth camera in its maps). A load beside the middle of the width twists a beam.
    one_layer: a planar graph, one cell wide, which is cheaper and takes the beam to be the same all over its width:
    fields are those of the visible face, loads and energies are told for the whole width. cell [m]: edge of the
    graph's cells, 0: the painted pitch; a whole part of it refines the graph, a whole multiple tracks only every
    second, third, ... node. pitch_tolerance: by how much the measured pitch may deviate from the told one.
    """

    width: float = 0.2
    pitch: float = 0.05
    material: Foam = field(default_factory=Foam)
    gravity: float = 9.81
    fps: float = 0.0
    depth: float = 1.2
    depth_maps: DepthOptions = field(default_factory=DepthOptions)
    clamp_side: ClampChoice = ClampChoice.auto
    fields: list[str] = field(default_factory=lambda: ["von_mises"])
    planar: bool = False
    one_layer: bool = False
    cell: float = 0.0
    pitch_tolerance: float = 0.1
    roll_doubt: float = 2e-3

    def __post_init__(self) -> None:
        if min(self.width, self.pitch, self.depth) <= 0:
            raise OptionError("Width, pitch and depth of a beam scene must be positive (in m).")
        if self.fps < 0 or min(self.gravity, self.roll_doubt) < 0 or not 0 < self.pitch_tolerance < 1:
            raise OptionError("fps, gravity and roll_doubt must not be negative, pitch_tolerance must lie in (0, 1).")
        unknown = [name for name in self.fields if name not in FIELDS and name not in DERIVED]
        if unknown:
            known = ", ".join([*FIELDS, *DERIVED])
            raise OptionError(f"The scene asks for the unknown field '{unknown[0]}'; known are {known}.")
        if self.one_layer and not self.planar:
            raise OptionError("A graph of one layer is planar; set planar=true or one_layer=false.")
        edge = self.cell_edge
        if edge <= 0 or min(abs(x - round(x)) for x in (self.pitch / edge, edge / self.pitch)) > 1e-6:
            raise OptionError(
                f"cell = {100 * self.cell:g} cm is neither a whole part nor a whole multiple of the painted pitch of "
                f"{100 * self.pitch:g} cm."
            )

    @property
    def cell_edge(self) -> float:
        """Edge of the graph's cells [m]."""
        return self.cell or self.pitch

    @property
    def stride(self) -> int:
        """How many painted pitches lie between two tracked nodes."""
        return max(round(self.cell_edge / self.pitch), 1)

    @property
    def refinement(self) -> int:
        """How many cells lie between two tracked nodes."""
        return max(round(self.pitch / self.cell_edge), 1)

    @property
    def copies(self) -> float:
        """How many times the body of the graph goes into the width: above 1 for a graph of one layer."""
        return self.width / self.cell_edge if self.one_layer else 1.0
