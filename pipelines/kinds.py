"""What differs between the scenes: a beam and a glass go through the same stages with other rooms behind them.

A `Kind` is chosen by the type of the options that a stage reads, which the groups `lab`, `vision`, `scene`, `twin` and
`twin_evaluation` of an experiment bring.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from zsdt.errors import OptionError
from zsdt.perception.camera import Camera
from zsdt.perception.video import FrameSource
from zsdt.shipped import TwinWeights


@dataclass(frozen=True)
class Kind:
    """A kind of scene.

    name: of the group's choice that people type; weights: folder of the shipped ones. lab, vision, scene, twin,
    evaluation: types of the options that belong to it.
    film(cfg, folder) -> figures: writes a set of clips. clips(folder): a set that was written. told(scene, clip): what
    the twin is told of a clip. placed(camera, twin): a camera of a user's own where nobody said where it stands.
    train_vision(cfg, out, scratch) -> figures. watch(cfg, parts, watched, out) -> figures: a twin in front of a video.
    evaluate(clips, parts, options, out, scratch, workers) -> figures: on all clips.
    """

    name: str
    weights: str
    lab: type
    vision: tuple[type, ...]
    scene: type
    twin: type
    evaluation: type
    film: Callable[[SimpleNamespace, Path], dict[str, Any]]
    clips: Callable[[Path], Any]
    told: Callable[[Any, Any], Any]
    placed: Callable[[Camera, Any], Camera]
    train_vision: Callable[[SimpleNamespace, Path, Path], dict[str, Any]]
    watch: Callable[[SimpleNamespace, TwinWeights, Watched, Path], dict[str, Any]]
    evaluate: Callable[[Path, TwinWeights, Any, Path, Path, int], dict[str, Any]]

    @property
    def types(self) -> tuple[type, ...]:
        """All option types of the kind."""
        return self.lab, *self.vision, self.scene, self.twin, self.evaluation


@dataclass(frozen=True)
class Watched:
    """What a twin watches: a clip of the lab (None: a video of a user's own), its frames, and what it is told."""

    clip: Any
    source: FrameSource
    scene: Any
    camera: Camera


def kinds() -> tuple[Kind, ...]:
    """All kinds of scenes."""
    from pipelines.beam_kind import BEAM
    from pipelines.glass_kind import GLASS

    return BEAM, GLASS


def kind_of(*options: Any) -> Kind:
    """The kind that all of these options belong to.

    Raises: OptionError where they belong to different ones.
    """
    found = [kind for part in options for kind in kinds() if isinstance(part, kind.types)]
    if len(found) != len(options) or len({kind.name for kind in found}) != 1:
        names = " and ".join(sorted({kind.name for kind in found}))
        raise OptionError(
            f"This experiment mixes scenes ({names}); choose scene, twin, lab, vision and twin_evaluation of one kind."
        )
    return found[0]


def kind_of_type(found: type | None) -> Kind | None:
    """The kind that a type of options belongs to, None for another one."""
    return next((kind for kind in kinds() if found in kind.types), None)
