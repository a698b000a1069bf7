"""How well the painted grid is seen: paint (IoU), nodes (precision, recall, pixels), order, clamp side, milliseconds.

Judged on pictures of which the truth is known, such as stills of the virtual lab in styles that training never saw.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from zsdt.errors import DataError
from zsdt.evaluation.liquid_report import markdown_table
from zsdt.evaluation.tables import write_csv
from zsdt.evaluation.vision_judge import NEAR, Case, JudgedStill, judge_still
from zsdt.evaluation.vision_pictures import write_cases
from zsdt.files import atomic_path
from zsdt.perception.grid_graph import GridOptions
from zsdt.perception.segmentation import Segmenter

# What is asked of unseen styles; the seed's U-Net reached an IoU of 0.769 and took 0.13 s.
TARGETS = {
    "iou": (0.90, "at least"),
    "node_precision": (0.99, "at least"),
    "node_recall": (0.99, "at least"),
    "error_px_median": (0.8, "at most"),
    "error_px_p95": (3.0, "at most"),
    "unet_ms_p50": (130.0, "at most"),
}


@dataclass(frozen=True)
class VisionTable:
    """A row for each picture, and the summary of all of them."""

    rows: list[dict[str, Any]]
    summary: dict[str, Any]


def judge_vision(
    segmenter: Segmenter,
    stills: Iterable[JudgedStill],
    folder: str | Path | None = None,
    options: GridOptions | None = None,
) -> VisionTable:
    """Segments every still, extracts its grid and compares both with the truth.

    Where the clamp's side cannot be told, the grid is judged with the side given, and the row says `clamp: asked`.
    Milliseconds are wall time and processor time of all threads, after one picture of warm-up, segmentation and grid
    apart. With `folder`, writes
    vision.csv, vision.md, vision.json and pictures of the worst and the most typical cases. Raises: DataError where
    there are no stills.
    """
    cases: list[Case] = []
    for number, still in enumerate(stills):
        if not cases:
            segmenter.probability(still.image)
        cases.append(judge_still(segmenter, still, number, options or GridOptions()))
    if not cases:
        raise DataError("There are no pictures to judge vision by; give at least one.")
    table = VisionTable([case.row for case in cases], summarise(cases))
    if folder is not None:
        _write(Path(folder), table, cases)
    return table


def summarise(cases: Sequence[Case]) -> dict[str, Any]:
    """Means over pictures (IoU), over all nodes (precision, recall, pixels), and shares of pictures."""
    rows = [case.row for case in cases]
    errors = np.concatenate([case.errors_px for case in cases])
    total = {name: sum(row[name] for row in rows) for name in ("nodes_true", "nodes_found", "nodes_matched")}
    ious = [row["iou"] for row in rows]
    summary: dict[str, Any] = {
        "images": len(rows),
        "iou": float(np.mean(ious)),
        "iou_worst": float(min(ious)),
        "iou_of_face": float(np.mean([row["iou_of_face"] for row in rows])),
        "node_precision": total["nodes_matched"] / max(1, total["nodes_found"]),
        "node_recall": total["nodes_matched"] / total["nodes_true"],
        "node_recall_worst": float(min(row["node_recall"] for row in rows)),
        "error_px_median": float(np.median(errors)) if len(errors) else float("nan"),
        "error_px_p95": float(np.percentile(errors, 95)) if len(errors) else float("nan"),
        "error_px_max": float(errors.max()) if len(errors) else float("nan"),
        "no_grid": sum(case.grid is None for case in cases),
        "in_order": sum(bool(row["in_order"]) for row in rows),
    }
    summary |= {f"clamp_{word}": sum(row["clamp"] == word for row in rows) for word in ("right", "asked", "wrong")}
    for part in ("unet_ms", "grid_ms", "unet_cpu_ms", "grid_cpu_ms"):
        low, high = np.percentile([row[part] for row in rows], [50, 95])
        summary |= {f"{part}_p50": float(low), f"{part}_p95": float(high)}
    return {**summary, "threads": torch.get_num_threads(), **_size(cases)}


def _size(cases: Sequence[Case]) -> dict[str, str]:
    sizes = sorted({f"{c.still.image.shape[1]}x{c.still.image.shape[0]}" for c in cases})
    return {"size": " ".join(sizes)}


def verdicts(summary: dict[str, Any]) -> list[dict[str, Any]]:
    """Each target with what was measured, and whether it is met."""
    rows = []
    for name, (limit, sense) in TARGETS.items():
        value = summary[name]
        met = value >= limit if sense == "at least" else value <= limit
        rows.append({"figure": name, "target": f"{sense} {limit:g}", "measured": value, "met": "yes" if met else "NO"})
    return rows


def _write(folder: Path, table: VisionTable, cases: Sequence[Case]) -> None:
    write_csv(folder / "vision.csv", table.rows)
    with atomic_path(folder / "vision.json") as beside:
        beside.write_text(json.dumps(table.summary, indent=1))
    shown = write_cases(folder, cases)
    with atomic_path(folder / "vision.md") as beside:
        beside.write_text(_page(table, shown))


def _page(table: VisionTable, shown: Sequence[str]) -> str:
    summary = [{"figure": name, "value": value} for name, value in table.summary.items()]
    return "\n".join(
        [
            "# What vision sees of the painted grid",
            "",
            f"{table.summary['images']} pictures of the virtual lab ({table.summary['size']} px), "
            f"{table.summary['threads']} threads. IoU is the mean over pictures (iou_of_face: of the paint on the "
            "found face alone); precision, recall and pixels are over all nodes; a node counts within "
            f"{NEAR:g} of the pitch. Milliseconds are wall time, cpu_ms those of all threads together.",
            "",
            markdown_table(verdicts(table.summary)),
            "",
            markdown_table(summary),
            "",
            markdown_table(table.rows),
            "",
            *[f"![{name}]({name}.png)" for name in shown],
            "",
        ]
    )
