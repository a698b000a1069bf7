"""Geometry of glasses judged on the virtual lab, from the command line.

`python -m zsdt.evaluation.glass_geometry_bench OUT` reads `--glasses` painted glasses of all families, their surfaces
askew, and `--stops` stops of which only the outlines are drawn, and writes tables and a picture into OUT.
`--camera raytrace` has the glasses ray-traced, `--clips FOLDER` takes simulated clips instead (for both questions), and
`--segmenter WEIGHTS` adds what a network sees to the exact masks.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from zsdt.errors import ZsdtError
from zsdt.evaluation.glass_geometry_cases import (
    GlassCase,
    Image,
    Masks,
    Reading,
    clip_case,
    clip_stop,
    drawn_stop,
    lab_case,
    read_case,
    true_contact,
)
from zsdt.evaluation.liquid_report import markdown_table
from zsdt.evaluation.plots import png_of
from zsdt.evaluation.tables import write_csv
from zsdt.files import atomic_path
from zsdt.lab.glass_clips import GlassClipSet
from zsdt.lab.glass_lab import GlassCamera, GlassLabOptions
from zsdt.lab.glass_shooting import glass_picture
from zsdt.perception.free_surface import project_surface, seen_wall
from zsdt.perception.glass_segmentation import load_glass_segmenter
from zsdt.perception.region_of_interest import RegionOfInterest
from zsdt.perception.segmentation import SegmentationBackend

VOLUME_LIMIT, PROFILE_LIMIT, FRAMES_LIMIT, STOPS_LIMIT = 5.0, 3.0, 1, 0.95
FIRST = 100  # number of the first glass: clips of a set have lower ones
SHOWN = (
    "radius_mm", "rim_mm", "cavity_pct", "cavity_pct_flat", "level_mm", "level_mm_unrefracted", "profile_pct",
    "profile_pct_unrefracted", "surface_pct", "surface_level_pct", "volume_pct", "volume_level_pct",
)  # fmt: skip
Segmenting = Callable[[], Callable[[Image], Masks]]


def following(weights: Path, backend: SegmentationBackend) -> Segmenting:
    """What gives for each clip a network that follows one glass."""
    segmenter = load_glass_segmenter(weights, backend)

    def fresh() -> Callable[[Image], Masks]:
        region = RegionOfInterest(segmenter)

        def masks(image: Image) -> Masks:
            seen = region.masks(image)
            return seen.container, seen.liquid

        return masks

    return fresh


def painted_cases(count: int, camera: GlassCamera) -> Iterator[GlassCase]:
    """Glasses of the lab in all families, filmed by a camera of a kind."""
    options = GlassLabOptions(camera=camera)
    for number in range(FIRST, FIRST + count):
        yield lab_case(number, options, glass_picture(options))


def read_all(
    cases: Iterable[GlassCase], source: str, segmenting: Segmenting | None
) -> tuple[list[dict[str, Any]], list[tuple[GlassCase, Reading]]]:
    """A row for each case and kind of masks, and what is drawn: the first of each family, from the last kind."""
    rows: list[dict[str, Any]] = []
    drawn: list[tuple[GlassCase, Reading]] = []
    for case in cases:
        for masks, segment in (("exact", None), ("network", segmenting() if segmenting else None)):
            if masks == "network" and segment is None:
                continue
            row: dict[str, Any] = {"case": case.name, "family": case.family.value, "source": source, "masks": masks}
            try:
                reading = read_case(case, segment)
            except ZsdtError as error:
                rows.append(row | {"error": str(error)})
                continue
            rows.append(row | reading.figures)
            if all(other.family is not case.family for other, _ in drawn):
                drawn.append((case, reading))
    return rows, drawn


def family_table(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Per source, masks and family: glasses, medians of the size of errors, worst of profile and volume, failures."""
    groups: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for row in rows:
        for family in (row["family"], "all"):
            groups.setdefault((row["source"], row["masks"], family), []).append(row)
    table = []
    for (source, masks, family), members in sorted(groups.items(), key=lambda g: (g[0][:2], g[0][2] == "all", g[0][2])):
        line: dict[str, Any] = {"source": source, "masks": masks, "family": family, "glasses": len(members)}
        line["failed"] = sum("error" in m or not np.isfinite(m.get("profile_pct", np.nan)) for m in members)
        for name in SHOWN:
            values = [abs(m[name]) for m in members if np.isfinite(m.get(name, np.nan))]
            line[name] = round(float(np.median(values)), 2) if values else ""
            if name in ("profile_pct", "volume_pct") and values:
                line[f"{name}_worst"] = round(max(values), 2)
        line["within"] = f"{sum(_within(m) for m in members)}/{len(members)}"
        table.append(line)
    return table


def _within(row: dict[str, Any]) -> bool:
    """Whether profile and volume are as well read as is asked for."""
    return bool(row.get("profile_pct", np.inf) <= PROFILE_LIMIT and abs(row.get("volume_pct", np.inf)) <= VOLUME_LIMIT)


def stop_table(stops: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Per kind of masks: clips, how many t0 are exact, within a frame, missed; instant and delay."""
    table = []
    for masks in dict.fromkeys(s["masks"] for s in stops):
        members = [s for s in stops if s["masks"] == masks]
        off = np.array([s["frames_off"] for s in members], float)
        instant = np.array([s["instant_ms"] for s in members], float)
        delay = np.array([s["told_after"] for s in members], float)
        table.append(
            {
                "masks": masks,
                "clips": len(members),
                "exact": int((off == 0).sum()),
                "within a frame": int((np.abs(off) <= FRAMES_LIMIT).sum()),
                "missed": int(np.isnan(off).sum()),
                "instant, mean ms": round(float(np.nanmean(instant)), 1),
                "instant, deviation ms": round(float(np.nanstd(instant)), 1),
                "told after, median frames": float(np.nanmedian(delay)),
                "at most": float(np.nanmax(delay)),
            }
        )
    return table


def picture(drawn: Sequence[tuple[GlassCase, Reading]]) -> bytes:
    """One panel a glass: the seen surface, columns that are not believed, and the true contact line."""
    figure = Figure(figsize=(2.6 * len(drawn), 3.1), layout="constrained")
    for k, (case, reading) in enumerate(drawn):
        _panel(figure.add_subplot(1, len(drawn), k + 1), case, reading)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncol=len(labels), frameon=False, fontsize=7)
    return png_of(figure)


def _panel(axes: Axes, case: GlassCase, reading: Reading) -> None:
    fit, profile = reading.fit, reading.profile
    axes.imshow(cv2.cvtColor(case.images[-1], cv2.COLOR_BGR2RGB))
    axes.plot(*profile.pixels[~profile.seen].T, ".", ms=2, color="tab:red", label="not believed")
    axes.plot(*profile.pixels[profile.seen].T, ".", ms=2.5, color="lime", label="seen surface")
    x, height = true_contact(case)
    line = project_surface(fit, fit.x, seen_wall(fit, fit.x, x, height), height)
    inside = np.abs(x) < 0.93 * profile.scale
    axes.plot(*line[inside].T, "--", lw=1.2, color="gold", label="true contact line")
    half = fit.outer[:, 0]
    for sign in (-1.0, 1.0):
        side = np.column_stack([fit.x + sign * half, np.zeros(len(half)), fit.outer[:, 1]])
        axes.plot(*fit.camera.project(side).T, lw=1.0, color="deepskyblue",
                  label="profile of the outside" if sign > 0 else None)  # fmt: skip
    pixels = fit.camera.project(np.column_stack([fit.x + half, np.zeros(len(half)), fit.outer[:, 1]]))
    middle = fit.camera.project(np.array([[fit.x, 0.0, 0.5 * fit.outer[-1, 1]]]))[0]
    reach = 1.35 * max(pixels[:, 0].max() - middle[0], 0.5 * float(np.ptp(pixels[:, 1])))
    axes.set_xlim(middle[0] - reach, middle[0] + reach)
    axes.set_ylim(middle[1] + reach, middle[1] - reach)
    errors = reading.figures
    axes.set_title(
        f"{case.family.value}: profile {errors.get('profile_pct', np.nan):.1f} % of the fill, "
        f"volume {errors.get('volume_pct', np.nan):+.1f} %", fontsize=6.5,
    )  # fmt: skip
    axes.set_axis_off()


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; the exit status, 1 where a target is missed."""
    parser = argparse.ArgumentParser(prog="python -m zsdt.evaluation.glass_geometry_bench", description=__doc__)
    parser.add_argument("out", type=Path, help="folder for the report")
    parser.add_argument("--glasses", type=int, default=20)
    parser.add_argument("--stops", type=int, default=50)
    parser.add_argument("--camera", type=GlassCamera, default=GlassCamera.painter)
    parser.add_argument("--clips", type=Path, help="folder of simulated clips instead")
    parser.add_argument("--segmenter", type=Path, help="folder with weights of a segmentation of glasses")
    parser.add_argument("--backend", type=SegmentationBackend, default=SegmentationBackend.eager)
    parser.add_argument("--threads", type=int, default=2)
    given = parser.parse_args(arguments)
    cv2.setNumThreads(given.threads)
    torch.set_num_threads(given.threads)
    try:
        segmenting = following(given.segmenter, given.backend) if given.segmenter else None
        if given.clips:
            clips = GlassClipSet(given.clips)
            rows, drawn = read_all((clip_case(clip) for clip in clips), "clips", segmenting)
            stops = [clip_stop(clip) | {"masks": "exact"} for clip in clips]
            stops += [clip_stop(clip, segmenting()) | {"masks": "network"} for clip in clips] if segmenting else []
        else:
            rows, drawn = read_all(painted_cases(given.glasses, given.camera), given.camera.value, segmenting)
            options = GlassLabOptions()
            stops = [drawn_stop(FIRST + k, options) | {"masks": "outlines"} for k in range(given.stops)]
    except ZsdtError as error:
        print(error, file=sys.stderr)
        return 2
    return report(given.out, rows, stops, drawn, _command(given))


def _command(given: argparse.Namespace) -> str:
    """The command line with words for folders."""
    words = ["python -m zsdt.evaluation.glass_geometry_bench OUT"]
    words += ["--clips CLIPS"] if given.clips else [f"--glasses {given.glasses}", f"--stops {given.stops}"]
    words += [f"--camera {given.camera.value}"] if not given.clips else []
    words += [f"--segmenter WEIGHTS --backend {given.backend.value}"] if given.segmenter else []
    return " ".join(words)


def report(
    out: Path,
    rows: list[dict[str, Any]],
    stops: list[dict[str, Any]],
    drawn: list[tuple[GlassCase, Reading]],
    command: str,
) -> int:
    """Writes glasses.csv, stops.csv, README.md and glasses.png; 1 where a target is missed, else 0."""
    out.mkdir(parents=True, exist_ok=True)
    lines = ["# Geometry of glasses in the virtual lab", "", f"`{command}`", ""]
    met = True
    if rows:
        write_csv(out / "glasses.csv", rows)
        table = family_table(rows)
        print(markdown_table(table))
        share = {m: [_within(r) for r in rows if r["masks"] == m] for m in dict.fromkeys(r["masks"] for r in rows)}
        met &= all(all(s) for s in share.values())
        lines += [GLASSES, "", markdown_table(table), ""]
    if drawn:
        with atomic_path(out / "glasses.png") as beside:
            beside.write_bytes(picture(drawn))
        lines += ["![Glasses as read](glasses.png)", ""]
    if stops:
        write_csv(out / "stops.csv", stops)
        table = stop_table(stops)
        print(markdown_table(table))
        met &= all(t["within a frame"] >= STOPS_LIMIT * t["clips"] for t in table)
        lines += [STOPS, "", markdown_table(table), ""]
    with atomic_path(out / "README.md") as beside:
        beside.write_text("\n".join(lines))
    return 0 if met else 1


GLASSES = (
    "Medians of the size of the errors (worst beside them). radius: root mean square below the level; cavity: volume "
    "of the cavity below the true level, flat: with the silhouette laid into the plane of the axis; level, profile: of "
    "the surface on the wall, unrefracted: with straight lines of sight; surface: of all of it over the cavity, "
    "volume: of the liquid, level: without its volume at rest. Profile and surface in % of the fill. within: glasses "
    f"with a profile within {PROFILE_LIMIT:g} % and a volume within {VOLUME_LIMIT:g} %."
)
STOPS = "t0 as told when the twin first is sure of it, held against the end of the excitation."

if __name__ == "__main__":
    sys.exit(main())
