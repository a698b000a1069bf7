"""Clips of glasses: a video, what the twin is told about it, and the truth that it is not told."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from zsdt.errors import DataError
from zsdt.files import atomic_path
from zsdt.lab.clip_files import (
    keep_frames,
    make_set,
    read_array,
    read_scene_card,
    set_figures,
    write_card,
    write_clip_index,
)
from zsdt.lab.filmed_clip import FilmedClip, FilmedSet
from zsdt.lab.glass_lab import GlassLabOptions, GlassPlan, hidden_glass, plan_glass_clips
from zsdt.lab.glass_shooting import GlassShooting
from zsdt.perception.camera import load_camera, save_camera
from zsdt.scene import Liquid
from zsdt.trajectory import write_trajectory

SCHEMA = "zsdt.glass_clip"
SCHEMA_VERSION = 1
INDEX_COLUMNS = ("name", "family", "regime", "contents", "frames", "fps")


@dataclass(frozen=True)
class GlassClipScene:
    """What the twin is told about a clip.

    liquid: its nominal card. wall, floor [m]: thickness of the wall of the glass, square to it, and below the cavity.
    glass_index, liquid_index: of refraction. section: (aspect, exponent) of the cross-section of a prism, half-width
    along y over the one along x and exponent of the superellipse; None: round. fps, gravity [m/s2]. The camera,
    slightly misjudged, is told beside it (`GlassClip.camera`): its x origin means nothing, its depth does (the axis of
    the vessel is at y = 0).
    """

    liquid: Liquid
    wall: float
    floor: float
    glass_index: float
    liquid_index: float
    section: tuple[float, float] | None
    fps: float
    gravity: float


@dataclass(frozen=True)
class GlassClip(FilmedClip[GlassClipScene]):
    """A clip of a glass. What the twin may use: `source`, `camera`, `scene`; all else is the truth.

    truth: in the axes of the vessel, at the times of all frames of the video; `body.vessel`, `body.liquid`: the lab's
    own; `body.motion`: history until t0, its times relative to t0. Empty glasses have the truth of a liquid that nobody
    sees. hidden: t0_frame, t0_s (from the first frame), family, factors, volume [m3], style, shutter, shake, flicker of
    frames.
    """

    @property
    def t0_frame(self) -> int:
        """First frame at or after the end of the excitation."""
        return int(self.hidden["t0_frame"])

    @cached_property
    def pose(self) -> Float[np.ndarray, "frames 3"]:
        """Place [m] of the centre of the cavity's floor in the room in every frame."""
        return read_array(self.folder / "pose.npy")

    @cached_property
    def surface(self) -> Float[np.ndarray, "frames rings angles"]:
        """Height [m] of the free surface in every frame over the polar grid of `zsdt.lab.glass_view.Glass`."""
        return read_array(self.folder / "surface.npy")

    def masks(self, frame: int) -> tuple[UInt8[np.ndarray, "height width"], UInt8[np.ndarray, "height width"]]:
        """Cover of the container (with the liquid) and of the apparent liquid in a frame, 0 to 255.

        Raises: DataError where the frame's masks were not stored.
        """
        container, liquid = self.covers(frame, "container", "liquid")
        return container, liquid


def make_glass_clip(plan: GlassPlan, options: GlassLabOptions, folder: str | os.PathLike[str]) -> dict[str, Any]:
    """Simulates and films one clip into a new folder; gives back its line of the index and what it cost [CPU-s].

    Raises: RunRejected where no case is borne, OptionError, DataError where the disk does not take it.
    """
    began = time.process_time()
    case, truth = hidden_glass(plan, options)
    simulated = time.process_time()
    shooting = GlassShooting(plan, options, case, truth)
    shape = case.shape
    scene = GlassClipScene(
        liquid=options.nominal,
        wall=case.wall,
        floor=case.floor,
        glass_index=options.glass_index,
        liquid_index=options.liquid_index,
        section=None if shape.is_round else (shape.aspect, shape.exponent),
        fps=options.fps,
        gravity=options.gravity,
    )
    with atomic_path(folder) as beside:
        (beside / "masks").mkdir(parents=True)
        keep_frames(beside, _film(shooting, beside, options.mask_every), options.storage, options.fps)
        filmed = time.process_time()
        write_trajectory(beside / "truth.h5", truth)
        with (beside / "pose.npy").open("wb") as file:
            np.save(file, case.path)
        with (beside / "surface.npy").open("wb") as file:
            np.save(file, shooting.surfaces)
        save_camera(beside / "camera.json", shooting.nominal_camera)
        save_camera(beside / "true_camera.json", shooting.camera)
        write_card(beside / "scene.json", {"schema": SCHEMA, "schema_version": SCHEMA_VERSION, **asdict(scene)})
        write_card(beside / "truth.json", {**shooting.describe(), "meta": truth.meta})
    return {
        "name": plan.name,
        "frames": case.frames,
        "rejected": truth.meta["rejected"],
        "simulate_s": simulated - began,
        "film_s": filmed - simulated,
    }


def _film(shooting: GlassShooting, folder: Path, mask_every: int) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Takes the frames one by one and keeps some of their masks."""
    for frame in range(shooting.case.frames):
        taken = shooting.shoot(frame)
        if frame % mask_every == 0:
            for part, mask in (("container", taken.container_mask), ("liquid", taken.liquid_mask)):
                cv2.imwrite(str(folder / "masks" / f"{frame:05d}_{part}.png"), mask)
        yield taken.image


def read_glass_clip(folder: str | os.PathLike[str]) -> GlassClip:
    """A clip that `make_glass_clip` made. Raises: DataError where the folder is no clip or of another version."""
    root = Path(folder)
    card = read_scene_card(root, SCHEMA, SCHEMA_VERSION)
    try:
        section = card.pop("section")
        scene = GlassClipScene(
            liquid=Liquid(**card.pop("liquid")), section=tuple(section) if section is not None else None, **card
        )
    except (TypeError, KeyError, ValueError) as error:
        raise DataError(f"{root / 'scene.json'} does not describe a clip ({error}); make the clip again.") from error
    return GlassClip(root, scene, load_camera(root / "camera.json"))


class GlassClipSet(FilmedSet[GlassClip]):
    """Clips of glasses in a folder."""

    def read(self, folder: Path) -> GlassClip:
        """A clip of the set."""
        return read_glass_clip(folder)


def make_glass_clips(options: GlassLabOptions, out: str | os.PathLike[str], workers: int = 1) -> dict[str, Any]:
    """Writes a set of clips into folder `out`, the same for any number of `workers`.

    Clips that are complete there already stay, if they were made with the same options. Gives back numbers for a
    manifest (see `zsdt.lab.clip_files.set_figures`).

    Raises: OptionError, DataError (other options, disk), RunRejected where a clip finds no case that is borne.
    """
    folder, plans = Path(out), plan_glass_clips(options)
    made = make_set(make_glass_clip, plans, options, folder, workers)
    rows = []
    for plan in plans:
        clip = read_glass_clip(folder / plan.name)
        rows.append(
            {
                "name": plan.name,
                **{name: clip.hidden[name] for name in ("family", "regime", "contents")},
                "frames": len(clip.pose),
                "fps": options.fps,
            }
        )
    write_clip_index(folder, INDEX_COLUMNS, rows)
    return set_figures(len(plans), sum(figures["frames"] for figures in made.values()), made, workers)
