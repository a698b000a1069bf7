"""What a planner can choose for a twin, and the twin's options with a choice put in.

A choice knows its words for people, and its columns in the measured data.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, runtime_checkable

from zsdt.errors import OptionError
from zsdt.twin.loop_common import LoopOptions

if TYPE_CHECKING:  # a beam needs nothing of a glass
    from zsdt.tignn.engine import Engine
    from zsdt.tignn.particle_engine import ParticleEngine
    from zsdt.twin.glass_scene import GlassTwinScene
    from zsdt.twin.twin_scene import BeamTwinScene

ENDINGS = {2: "nd", 3: "rd"}
Loop = TypeVar("Loop", bound=LoopOptions)


@runtime_checkable
class Choice(Protocol):
    """One way to run a twin."""

    @property
    def look_every(self) -> int:
        """Frames from one look to the next."""

    def words(self, scene: Any) -> str:
        """For people."""

    def columns(self) -> dict[str, float]:
        """Of the measured data."""


@dataclass(frozen=True)
class BeamChoice:
    """Graph and cadence of a beam's twin. cells: per painted pitch (0.5: every second painted node is tracked);
    one_layer: planar, one cell wide."""

    cells: float = 1.0
    one_layer: bool = False
    look_every: int = 1

    def words(self, scene: BeamTwinScene) -> str:
        """For people."""
        graph = "planar (one cell wide)" if self.one_layer else "3D"
        return f"cells of {100 * scene.pitch / self.cells:g} cm, {graph}, {cadence(self.look_every)}"

    def columns(self) -> dict[str, float]:
        """Of the measured data."""
        return {"cells": self.cells, "one_layer": float(self.one_layer), "look_every": float(self.look_every)}

    def scene(self, scene: BeamTwinScene) -> BeamTwinScene:
        """The scene with this graph."""
        planar = scene.planar or self.one_layer
        return replace(scene, cell=scene.pitch / self.cells, planar=planar, one_layer=self.one_layer)


@dataclass(frozen=True)
class GlassChoice:
    """Particles and cadence of a glass's twin. sound: of the liquid's computed sound speed over the engine's own: below
    1 it is softer and needs fewer sub-steps."""

    particles: int = 700
    sound: float = 1.0
    look_every: int = 1

    def words(self, scene: GlassTwinScene) -> str:
        """For people."""
        soft = "" if self.sound == 1.0 else f" at {self.sound:g} of the sound speed"
        return f"{self.particles} particles{soft}, {cadence(self.look_every)}"

    def columns(self) -> dict[str, float]:
        """Of the measured data."""
        return {"particles": float(self.particles), "sound": self.sound, "look_every": float(self.look_every)}

    def scene(self, scene: GlassTwinScene) -> GlassTwinScene:
        """The scene with so many particles."""
        return replace(scene, particles=self.particles)

    def engine(self, engine: Engine) -> ParticleEngine:
        """The engine with this sound speed; the given one stays as it is.

        Raises: OptionError for a network of the node form, which has no sound speed of its own.
        """
        from zsdt.tignn.particle_engine import ParticleEngine

        if not isinstance(engine, ParticleEngine):
            raise OptionError("Choices were measured with the particle form; train one with tignn.form=particle.")
        own = copy.copy(engine)
        own.options = replace(engine.options, sound_speed=self.sound * engine.options.sound_speed)
        return own


def cadence(look_every: int) -> str:
    """Words for how often a twin looks."""
    if look_every == 1:
        return "a look at every frame"
    return f"a look at every {look_every}{ENDINGS.get(look_every, 'th')} frame"


def with_cadence(loop: Loop, choice: Choice) -> Loop:
    """Options of a loop that looks as often as the choice says."""
    return replace(loop, look_every=choice.look_every)


BEAM_CHOICES = (
    *(
        BeamChoice(cells, one_layer, look_every)
        for cells, one_layer in ((1.0, False), (1.0, True), (2.0, True), (0.5, True))
        for look_every in (1, 2, 4)
    ),
    BeamChoice(2.0, False, 1),
)
GLASS_CHOICES = tuple(
    GlassChoice(particles, sound, look_every)
    for particles, sound in ((700, 1.0), (150, 1.0), (300, 1.0), (1500, 1.0), (700, 0.5))
    for look_every in (1, 3)
)
