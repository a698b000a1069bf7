"""Clips of the virtual lab for the measured data and for holding plans against what was not measured, and the files of
rows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from zsdt.files import atomic_path
from zsdt.lab.beam_lab import BeamLabOptions, trained_sizes
from zsdt.lab.clip_files import Storage
from zsdt.lab.clips import make_clips
from zsdt.lab.glass_clips import make_glass_clips
from zsdt.lab.glass_lab import GlassLabOptions
from zsdt.solid.sampler import SynthesisOptions

SEEDS = {"measured": 60, "held_out": 61}
CLIPS = 6  # of each set
FRAMES = 90
TRAINED = SynthesisOptions(train=24, val=4, test=6, beyond=2)  # whose sizes the shipped weights have met


def film(kind: str, which: str, out: Path, workers: int = 1) -> list[Path]:
    """Clips of a set (measured or held_out) of a kind (beam or glass), filmed where they are not there."""
    folder = out / f"{kind}_{which}"
    out.mkdir(parents=True, exist_ok=True)
    if not (folder / "index.csv").is_file():
        if kind == "beam":
            options = BeamLabOptions(
                clips=CLIPS, frames=FRAMES, seed=SEEDS[which], exclude_cm=trained_sizes(TRAINED),
                storage=Storage.jpg, mask_every=1000,
            )  # fmt: skip
            make_clips(options, folder, workers=workers)
        else:
            make_glass_clips(
                GlassLabOptions(clips=CLIPS, seed=SEEDS[which], storage=Storage.jpg, mask_every=1),
                folder,
                workers=workers,
            )
    return clips_in(folder)


def clips_in(folder: Path) -> list[Path]:
    """The clips of a set in the order of their index."""
    return [folder / name for name in pd.read_csv(folder / "index.csv")["name"]]


def write_rows(path: Path, rows: Sequence[dict[str, Any]], command: str, commit: str) -> Path:
    """Rows as CSV with a first line that says what made them."""
    table = pd.DataFrame(list(rows))
    numbers = table.select_dtypes("number").columns
    table[numbers] = table[numbers].map(lambda value: float(f"{value:.5g}"))
    with atomic_path(path) as beside:
        beside.write_text(f"# Made by `{command}` at commit {commit}.\n{table.to_csv(index=False)}")
    return path
