"""`python -m pipelines.plan scene=foam_beam budget.error=0.2 budget.frame_ms=5`: which twin a budget allows, and why.

The overrides are those of `python -m pipelines`; `twin.plan=true` with the same budget runs the twin as planned.

`--measure [beam|glass]` films clips of the virtual lab (or takes `--clips FOLDER`), runs the twin on them with every
choice that there is and writes the measured data that come with the package. `--validate` plans ten pairs of scene and
budget, measures all choices on clips that the data do not hold, and writes the table into docs/results/plan.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipelines.provenance import commit_words, set_thread_environment
from zsdt.errors import OptionError, ZsdtError

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "zsdt" / "planning" / "data"


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints a plan, or makes the data; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m pipelines.plan", description=__doc__)
    parser.add_argument("overrides", nargs="*", help="KEY=VALUE, as of python -m pipelines")
    parser.add_argument("--measure", choices=("beam", "glass"), help="make the measured data of a kind of scene")
    parser.add_argument("--validate", action="store_true", help="plans against all choices on other clips")
    parser.add_argument("--kinds", nargs="+", default=["beam", "glass"], help="kinds of scenes to validate")
    parser.add_argument("--clips", type=Path, nargs="+", help="folders of clips instead of filming some")
    parser.add_argument("--outputs", type=Path, default=Path("outputs"), help="folder of clips that are filmed")
    parser.add_argument("--docs", type=Path, default=ROOT / "docs" / "results", help="folder of the table")
    parser.add_argument(
        "--lab-masks", action="store_true", help="of glasses: the lab's own masks instead of a network's"
    )
    parser.add_argument("--again", action="store_true", help="take the rows of the last --validate, run nothing")
    chosen = parser.parse_args(arguments)
    set_thread_environment(1)
    try:
        if chosen.measure:
            _measure(chosen.measure, chosen)
        elif chosen.validate:
            _validate(chosen)
        else:
            print(plan_of(chosen.overrides).words)
    except ZsdtError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def plan_of(overrides: Sequence[str]) -> Any:
    """The plan of a config. Raises: OptionError where it has no scene, RunRejected where the budget cannot be met."""
    from pipelines.registry import APPLICATION
    from pipelines.stages import settings_of
    from zsdt.planning.planner import plan_beam, plan_glass
    from zsdt.twin.glass_scene import GlassTwinScene

    settings = settings_of(APPLICATION.compose(list(overrides)), ("scene", "budget"))
    if settings.scene is None:
        raise OptionError("There is nothing to plan for; say scene=foam_beam or scene=glass.")
    plan = plan_glass if isinstance(settings.scene, GlassTwinScene) else plan_beam
    return plan(settings.scene, settings.budget)


def _measure(kind: str, chosen: argparse.Namespace) -> None:
    from zsdt.planning.cases import film, write_rows

    folders = chosen.clips or film(kind, "measured", chosen.outputs / "plan")
    rows = _runs(kind, folders, chosen.lab_masks)
    command = f"python -m pipelines.plan --measure {kind}{' --lab-masks' if chosen.lab_masks else ''}"
    print(f"Written to {write_rows(DATA / f'{kind}.csv', rows, command, commit_words())}")


def _runs(kind: str, folders: Sequence[Path], lab_masks: bool) -> list[dict[str, Any]]:
    """All choices on all clips, on one thread. lab_masks: of glasses, instead of the segmentation's."""
    import cv2
    import torch

    from zsdt.evaluation.true_masks import TrueMasks
    from zsdt.planning.measure import measure_beams, measure_glasses
    from zsdt.shipped import TwinWeights, shipped

    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    name = "foam_beam" if kind == "beam" else "glycerin_glass"
    weights = TwinWeights(shipped(name, "tignn"), shipped(name, "psi_ini"), shipped(name, "vision"))
    if kind == "beam":
        return measure_beams(folders, weights)
    return measure_glasses(folders, weights, segmenter_of=TrueMasks if lab_masks else None)


def _validate(chosen: argparse.Namespace) -> None:
    from zsdt.planning.cases import film, write_rows
    from zsdt.planning.models import Measured, read_rows, shipped_data
    from zsdt.planning.page import write_page
    from zsdt.planning.validation import PAIRS, judge_pairs

    judged, notes = [], []
    for kind in chosen.kinds:
        kept = chosen.outputs / "plan" / f"held_out_{kind}.csv"
        if not chosen.again:
            folders = chosen.clips or film(kind, "held_out", chosen.outputs / "plan")
            write_rows(
                kept, _runs(kind, folders, chosen.lab_masks), "python -m pipelines.plan --validate", commit_words()
            )
        pairs = [pair for pair in PAIRS if pair.kind == kind]
        judged += judge_pairs(pairs, shipped_data(kind), Measured(read_rows(kept), kind))
        made = (DATA / f"{kind}.csv").read_text().splitlines()[0].lstrip("# ")
        notes.append(f"- Measured data of the {kind}: {made}")
    page = write_page(chosen.docs, judged, notes, "python -m pipelines.plan --validate", commit_words())
    print(page.read_text())


if __name__ == "__main__":
    sys.exit(main())
