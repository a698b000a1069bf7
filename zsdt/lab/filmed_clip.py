"""A clip of any laboratory on the disk, and a set of clips: what the twin may see, and the truth in files beside it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import cv2
from jaxtyping import UInt8
from numpy import ndarray

from zsdt.errors import DataError
from zsdt.lab.clip_files import kept_frames, read_card, read_index
from zsdt.perception.camera import Camera, load_camera
from zsdt.perception.video import FrameSource
from zsdt.trajectory import Trajectory, read_trajectory


@runtime_checkable
class HasFrameRate(Protocol):
    """What the twin is told about a clip holds at least its frames per second."""

    @property
    def fps(self) -> float: ...


Told = TypeVar("Told", bound=HasFrameRate)
AnyClip = TypeVar("AnyClip", bound="FilmedClip[Any]")


@dataclass(frozen=True)
class FilmedClip(Generic[Told]):
    """A clip on the disk. What the twin may use: `source`, `camera`, `scene`; all else is the truth."""

    folder: Path
    scene: Told
    camera: Camera

    @property
    def name(self) -> str:
        """Name of the clip."""
        return self.folder.name

    def source(self) -> FrameSource:
        """Its frames."""
        return kept_frames(self.folder, self.scene.fps)

    @cached_property
    def truth(self) -> Trajectory:
        """What the body really did."""
        return read_trajectory(self.folder / "truth.h5")

    @cached_property
    def hidden(self) -> dict[str, Any]:
        """The rest of the truth."""
        return read_card(self.folder / "truth.json")

    @cached_property
    def true_camera(self) -> Camera:
        """The camera that took the clip, at rest."""
        return load_camera(self.folder / "true_camera.json")

    def covers(self, frame: int, *parts: str) -> tuple[UInt8[ndarray, "height width"], ...]:
        """How much of each pixel these parts cover in a frame, 0 to 255.

        Raises: DataError where the frame's masks were not stored.
        """
        files = [self.folder / "masks" / f"{frame:05d}_{part}.png" for part in parts]
        read = (cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files)
        found = tuple(mask for mask in read if mask is not None)
        if len(found) < len(parts):
            raise DataError(f"{self.folder} holds no masks of frame {frame}; make clips with a smaller mask_every.")
        return found


class FilmedSet(Generic[AnyClip]):
    """A folder with `index.csv` and one folder per clip. Raises: DataError where there is none."""

    def __init__(self, folder: str | os.PathLike[str]):
        self.folder = Path(folder)
        self.entries = read_index(self.folder)

    def read(self, folder: Path) -> AnyClip:
        """A clip of the set."""
        raise NotImplementedError

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[AnyClip]:
        for entry in self.entries:
            yield self.read(self.folder / entry["name"])

    def __getitem__(self, number: int) -> AnyClip:
        return self.read(self.folder / self.entries[number]["name"])
