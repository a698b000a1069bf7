"""Clips of the virtual laboratory: a video, what the twin is told about it, and the truth that it is not told."""

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
from zsdt.lab.beam_lab import BeamLabOptions, ClipPlan, plan_clips, simulate_hidden
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
from zsdt.lab.shooting import Shooting
from zsdt.perception.camera import ClampSide, load_camera, save_camera
from zsdt.perception.depth import DepthOptions
from zsdt.scene import Foam, Modulus
from zsdt.trajectory import write_trajectory

SCHEMA = "zsdt.clip"
SCHEMA_VERSION = 1
DEPTH_UNIT = 1e-4  # m per grey level of a depth map
INDEX_COLUMNS = ("name", "regime", "size_cm", "clamp_side", "frames", "fps")


@dataclass(frozen=True)
class ClipScene:
    """What the twin is told about a clip: size of the beam into the picture and pitch of its grid [m], material,
    side of the clamp (``auto``: to be found), depth of the visible face along the optical axis [m], fps, gravity."""

    beam_width: float
    pitch: float
    material: Foam
    clamp_side: str
    depth: float
    fps: float
    gravity: float


@dataclass(frozen=True)
class Clip(FilmedClip[ClipScene]):
    """A clip of a beam. What the twin may use: `source`, `camera`, `scene`, `depth`; all else is the truth.

    truth: at the times of the frames. hidden: clamp_side, factors of the material, style, shutter, shake and flicker of
    frames.
    """

    @property
    def depth(self) -> DepthOptions | None:
        """Where its depth maps are, if a depth camera filmed as well (see `zsdt.perception.depth`)."""
        folder = self.folder / "depth"
        return DepthOptions(folder=str(folder), unit=DEPTH_UNIT) if folder.is_dir() else None

    @property
    def clamp_side(self) -> ClampSide:
        """Where the clamp really is."""
        return ClampSide(self.hidden["clamp_side"])

    @cached_property
    def pixels(self) -> Float[np.ndarray, "frames columns rows 2"]:
        """Exact pixels of the nodes of the visible face in every frame."""
        return read_array(self.folder / "pixels.npy")

    def masks(self, frame: int) -> tuple[UInt8[np.ndarray, "height width"], UInt8[np.ndarray, "height width"]]:
        """Cover of the grid lines and of the visible face in a frame, 0 to 255.

        Raises: DataError where the frame's masks were not stored.
        """
        grid, beam = self.covers(frame, "grid", "beam")
        return grid, beam


def make_clip(plan: ClipPlan, options: BeamLabOptions, folder: str | os.PathLike[str]) -> dict[str, Any]:
    """Simulates and films one clip into a new folder; gives back its line of the index and what it cost [CPU-s].

    Raises: RunRejected where the beam bears no load that is drawn, DataError where the disk does not take it.
    """
    began = time.process_time()
    truth = simulate_hidden(plan, options)
    simulated = time.process_time()
    shooting = Shooting(plan, options, truth)
    with atomic_path(folder) as beside:
        (beside / "masks").mkdir(parents=True)
        if options.depth_maps:
            (beside / "depth").mkdir()
        keep_frames(beside, _film(shooting, beside, options), options.storage, options.fps)
        filmed = time.process_time()
        write_trajectory(beside / "truth.h5", truth)
        with (beside / "pixels.npy").open("wb") as file:
            np.save(file, np.stack([shooting.pixels(k) for k in range(options.frames)]))
        save_camera(beside / "camera.json", shooting.nominal_camera)
        save_camera(beside / "true_camera.json", shooting.camera)
        scene = ClipScene(
            beam_width=plan.size_cm[1] / 100.0,
            pitch=options.pitch,
            material=options.nominal,
            clamp_side="auto",
            depth=shooting.nominal_depth,
            fps=options.fps,
            gravity=options.gravity,
        )
        write_card(beside / "scene.json", {"schema": SCHEMA, "schema_version": SCHEMA_VERSION, **asdict(scene)})
        write_card(beside / "truth.json", {**shooting.describe(), "meta": truth.meta})
    return {
        "name": plan.name,
        "regime": plan.regime.value,
        "size_cm": "x".join(map(str, plan.size_cm)),
        "clamp_side": shooting.side.value,
        "frames": options.frames,
        "fps": options.fps,
        "rejected": truth.meta["rejected"],
        "simulate_s": simulated - began,
        "film_s": filmed - simulated,
    }


def _film(shooting: Shooting, folder: Path, options: BeamLabOptions) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Paints the frames one by one and keeps some of their masks."""
    for frame in range(options.frames):
        painted = shooting.paint(frame)
        if frame % options.mask_every == 0:
            for part, mask in (("grid", painted.grid_mask), ("beam", painted.beam_mask)):
                cv2.imwrite(str(folder / "masks" / f"{frame:05d}_{part}.png"), mask)
        if options.depth_maps:
            levels = np.clip(np.rint(shooting.depth_map(frame) / DEPTH_UNIT), 0, 65535).astype(np.uint16)
            cv2.imwrite(str(folder / "depth" / f"{frame:05d}.png"), levels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        yield painted.image


def read_clip(folder: str | os.PathLike[str]) -> Clip:
    """A clip that `make_clip` made. Raises: DataError where the folder is no clip or of another version."""
    root = Path(folder)
    card = read_scene_card(root, SCHEMA, SCHEMA_VERSION)
    try:
        material = card.pop("material")
        foam = Foam(**{**material, "modulus": Modulus(material["modulus"])})
        scene = ClipScene(material=foam, **card)
    except (TypeError, KeyError, ValueError) as error:
        raise DataError(f"{root / 'scene.json'} does not describe a clip ({error}); make the clip again.") from error
    return Clip(root, scene, load_camera(root / "camera.json"))


class ClipSet(FilmedSet[Clip]):
    """Clips of beams in a folder."""

    def read(self, folder: Path) -> Clip:
        """A clip of the set."""
        return read_clip(folder)


def make_clips(options: BeamLabOptions, out: str | os.PathLike[str], workers: int = 1) -> dict[str, Any]:
    """Writes a set of clips into folder `out`, the same for any number of `workers`.

    Clips that are complete there already stay, if they were made with the same options. Gives back numbers for a
    manifest: clips, rejections by cause, processor seconds of simulation and of filming, per clip and per frame.

    Raises: OptionError, DataError (other options, disk), RunRejected where a beam bears no load.
    """
    folder, plans = Path(out), plan_clips(options)
    costly_first = sorted(plans, key=lambda plan: -int(np.prod(plan.size_cm)))
    made = make_set(make_clip, costly_first, options, folder, workers)
    rows = (
        {
            "name": plan.name,
            "regime": plan.regime.value,
            "size_cm": "x".join(map(str, plan.size_cm)),
            "clamp_side": read_clip(folder / plan.name).clamp_side.value,
            "frames": options.frames,
            "fps": options.fps,
        }
        for plan in plans
    )
    write_clip_index(folder, INDEX_COLUMNS, rows)
    return set_figures(len(plans), len(made) * options.frames, made, workers)
