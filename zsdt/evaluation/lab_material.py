"""Materials of the virtual lab's foams, read from their videos, against the truth that only the lab knows.

`python -m zsdt.evaluation.lab_material CLIPS WEIGHTS OUT` takes those clips of the folder CLIPS in which a beam is
plucked and left alone, finds the grid with the U-Net in WEIGHTS, and writes `lab_material` as CSV, Markdown and
picture. A virtual lab, not real videos: rendered by `zsdt.lab` from a finer simulation with another material.
"""

from __future__ import annotations

import argparse
import math
import shlex
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from zsdt.errors import DataError, RunRejected, ZsdtError
from zsdt.evaluation.liquid_report import CaseResult, write_case
from zsdt.lab.clips import Clip, ClipSet
from zsdt.perception.segmentation import Segmenter, load_segmenter
from zsdt.scene import Foam
from zsdt.solid.characterise import MaterialEstimate
from zsdt.solid.prony import complex_young, loss_factor
from zsdt.twin.twin_scene import BeamTwinScene
from zsdt.twin.video_material import material_from_video

PLUCKED = "impulse"


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; the exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    parser = argparse.ArgumentParser(prog="python -m zsdt.evaluation.lab_material", description=__doc__)
    parser.add_argument("clips", type=Path, help="folder of clips of the virtual lab")
    parser.add_argument("weights", type=Path, help="folder with the U-Net")
    parser.add_argument("out", type=Path, help="folder for table and picture")
    chosen = parser.parse_args(given)
    command = "python -m zsdt.evaluation.lab_material " + shlex.join(given)
    try:
        case = lab_material_case(ClipSet(chosen.clips), load_segmenter(chosen.weights))
        for path in write_case(chosen.out, "lab_material", command, case):
            print(path)
    except ZsdtError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print("\n".join(case.remarks))
    return 0


def scene_of(clip: Clip) -> BeamTwinScene:
    """What is told about a clip."""
    told = clip.scene
    return BeamTwinScene(
        width=told.beam_width, pitch=told.pitch, material=told.material, depth=told.depth, gravity=told.gravity
    )


def is_plucked(clip: Clip) -> bool:
    """Whether the beam of a clip swings freely for most of it."""
    return bool(clip.truth.meta["load"]["history"]["kind"] == PLUCKED)


def compare_material(name: str, found: MaterialEstimate, true: Foam) -> dict[str, Any]:
    """Errors [%] of what a video says, moduli over density, at the frequency that was seen."""
    s = 2j * math.pi * found.frequency
    ours = found.material

    def percent(value: float, truth: float) -> float:
        return 100.0 * (value / truth - 1.0)

    return {
        "clip": name,
        "Hz": found.frequency,
        "damping ratio": found.damping,
        "young over density %": percent(ours.young / ours.density, true.young / true.density),
        "told young over density %": None,
        "storage over density %": percent(
            found.storage_young / ours.density, complex_young(true, s).real / true.density
        ),
        "loss factor %": percent(found.loss_factor, loss_factor(true, found.frequency)),
        "g1": ours.g1,
        "true g1": true.g1,
        "refused": "",
    }


def lab_material_case(clips: Iterable[Clip], segmenter: Segmenter) -> CaseResult:
    """All plucked clips. Raises: DataError where there is none or none can be read."""
    rows: list[dict[str, Any]] = []
    for clip in clips:
        if not is_plucked(clip):
            continue
        true = clip.truth.body.material
        if true is None:
            raise DataError(f"The truth of {clip.name} names no material; make the clip again.")
        told = clip.scene.material
        try:
            found = material_from_video(clip.source(), segmenter, clip.camera, scene_of(clip))
        except (DataError, RunRejected) as refusal:
            rows.append({"clip": clip.name, "refused": str(refusal)})
            continue
        row = compare_material(clip.name, found, true)
        row["told young over density %"] = 100.0 * (told.young / told.density / (true.young / true.density) - 1.0)
        rows.append(row)
    done = [row for row in rows if not row["refused"]]
    if not done:
        raise DataError("Not one plucked clip could be read; make dynamic clips that begin at rest.")
    rows = [{head: row.get(head) for head in done[0]} for row in rows]
    return CaseResult(
        title="Materials of the virtual lab's foams, read from their videos",
        rows=rows,
        verdicts=[],
        remarks=_remarks(done, len(rows) - len(done)),
        figure=_figure(done),
    )


def _remarks(done: list[dict[str, Any]], refused: int) -> list[str]:
    def typical(name: str) -> str:
        values = np.abs([row[name] for row in done])
        return f"{np.median(values):.1f} % (worst {values.max():.1f} %)"

    return [
        f"Virtual lab, {len(done)} clips, {refused} refused. Median absolute errors: storage modulus over density "
        f"{typical('storage over density %')}, loss factor {typical('loss factor %')}, instantaneous Young's modulus "
        f"over density {typical('young over density %')}; the told material is off by "
        f"{typical('told young over density %')}.",
        "A video shows movement, no force: only moduli over the density can be read from it. tau is taken as told "
        "(one frequency does not say it), which is off by up to a fifth here.",
    ]


def _figure(done: list[dict[str, Any]]) -> Figure:
    figure = Figure(figsize=(9.0, 0.36 * len(done) + 1.6), layout="constrained")
    axis = figure.add_subplot()
    place = np.arange(len(done))
    for name, colour, mark in (
        ("told young over density %", "#999999", "x"),
        ("young over density %", "#E69F00", "s"),
        ("storage over density %", "#0072B2", "o"),
        ("loss factor %", "#009E73", "^"),
    ):
        axis.plot([row[name] for row in done], place, mark, color=colour, label=name[:-2])
    axis.axvline(0.0, color="black", lw=0.6)
    axis.set_yticks(place, [row["clip"] for row in done])
    axis.set_xlabel("error [%]")
    axis.invert_yaxis()
    axis.grid(alpha=0.25)
    figure.legend(loc="outside upper center", ncol=4)
    return figure


if __name__ == "__main__":
    sys.exit(main())
