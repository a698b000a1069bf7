"""A real silicone beam, characterised without a mass, predicted with 52 g and 101 g, and followed by the twin.

`python -m zsdt.evaluation.silicone_report OUT` writes three cases below OUT, each as CSV, Markdown and picture:
`silicone_prediction`, `silicone_twin` (a withheld marker) and `silicone_choices`. Exit status 1 where a required figure
is missed. The recordings are real (motion capture by Dubied et al., see `zsdt.interop.silicone_beam`).
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from zsdt.errors import ZsdtError
from zsdt.evaluation.liquid_report import CaseResult, Verdict, write_case
from zsdt.evaluation.silicone import (
    POISSON,
    SKIP,
    Prediction,
    compare,
    damping_over_time,
    material_of,
    predict_cell,
    predict_fem,
)
from zsdt.evaluation.silicone_choices import choice_row, choices
from zsdt.evaluation.silicone_plots import choices_figure, prediction_figure, twin_figure
from zsdt.evaluation.silicone_twin import Withheld, leave_one_out
from zsdt.files import atomic_path
from zsdt.interop.silicone_beam import AUTHORS_YOUNG, RECORDINGS, SiliconeRecording, read_silicone
from zsdt.scene import Foam
from zsdt.solid.characterise import MaterialEstimate

DROP_GOAL, FREQUENCY_GOAL = 10.0, 5.0  # percent
SHOWN = (
    "recording",
    "method",
    "measured drop mm",
    "predicted drop mm",
    "drop error %",
    "Tip-1 drop error %",
    "measured Hz",
    "predicted Hz",
    "frequency error %",
    "measured damping",
    "predicted damping",
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; the exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    parser = argparse.ArgumentParser(prog="python -m zsdt.evaluation.silicone_report", description=__doc__)
    parser.add_argument("out", type=Path, help="folder for tables and pictures")
    parser.add_argument("--data", type=Path, default=None, help="folder with the recordings")
    chosen = parser.parse_args(given)
    command = "python -m zsdt.evaluation.silicone_report " + shlex.join(given)
    try:
        passed = report(chosen.out, chosen.data, command)
    except ZsdtError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0 if passed else 1


def report(out: Path, data: Path | None, command: str) -> bool:
    """Writes all cases; whether every required figure is met. Raises: DataError, RunRejected."""
    recordings = {name: read_silicone(name, data) for name in RECORDINGS}
    free = recordings["gravity"]
    estimate = material_of(free)
    with atomic_path(out / "silicone_material.json") as part:
        part.write_text(json.dumps(estimate.summary() | {"notes": estimate.notes}, indent=1))
    predictions = {
        name: [predict_fem(r, estimate.material), predict_cell(r, estimate.material)] for name, r in recordings.items()
    }
    cases = {
        "silicone_prediction": _prediction_case(recordings, predictions, estimate),
        "silicone_twin": _twin_case(recordings, predictions, estimate.material),
        "silicone_choices": _choices_case(free, [recordings["load52"], recordings["load101"]]),
    }
    for name, case in cases.items():
        for path in write_case(out, name, command, case):
            print(path)
        for verdict in case.verdicts:
            print(verdict.line())
    return all(verdict.passed for case in cases.values() for verdict in case.verdicts)


def _prediction_case(
    recordings: dict[str, SiliconeRecording], predictions: dict[str, list[Prediction]], estimate: MaterialEstimate
) -> CaseResult:
    rows = [compare(r, p) for name, r in recordings.items() for p in predictions[name]]
    verdicts = []
    for row in rows:
        if row["recording"] == "gravity":
            continue
        who = f"{row['recording']}, {row['method']}"
        drops = [float(row["drop error %"]), float(row["Tip-1 drop error %"])]
        verdicts.append(
            Verdict(
                f"{who}: static drop",
                f"{drops[0]:+.1f} % (mean of three markers), {drops[1]:+.1f} % (Tip-1)",
                f"within {DROP_GOAL:.0f} %",
                max(abs(d) for d in drops) <= DROP_GOAL,
            )
        )
        swing = float(row["frequency error %"])
        verdicts.append(
            Verdict(
                f"{who}: frequency",
                f"{row['predicted Hz']:.2f} Hz for {row['measured Hz']:.2f} Hz ({swing:+.1f} %)",
                f"within {FREQUENCY_GOAL:.0f} %",
                abs(swing) <= FREQUENCY_GOAL,
            )
        )
    return CaseResult(
        title="A real silicone beam: characterised without a mass, predicted with one",
        rows=rows,
        verdicts=verdicts,
        remarks=[*_material_remarks(estimate), *_prediction_remarks(recordings)],
        figure=prediction_figure(recordings, predictions),
        shown=SHOWN,
    )


def _material_remarks(e: MaterialEstimate) -> list[str]:
    m = e.material
    return [
        f"Real recordings (motion capture). From the recording without a mass alone: relaxed Young's modulus "
        f"{1e-3 * e.relaxed_young:.1f} kPa, g1 = {m.g1:.3f}, tau = {1e3 * m.tau:.1f} ms (Poisson {POISSON}; tau by "
        f"the choice of the least g1). The static shape alone asks for {1e-3 * e.static_young:.1f} +- "
        f"{1e-3 * e.static_young_sd:.0f} kPa (held straight to about a millimetre), the vibration alone for "
        f"{1e-3 * e.vibration_young:.1f} kPa, closed-form bending with shear for {1e-3 * e.beam_theory_young:.1f} kPa "
        f"(a clamp that holds the whole cross-section is stiffer than beam theory says; the beam is only 3.3 times as "
        f"long as deep). The authors' fit to all their recordings is {1e-3 * AUTHORS_YOUNG:.1f} kPa.",
        f"Well known whatever is chosen: storage modulus {1e-3 * e.storage_young:.1f} kPa and loss factor "
        f"{e.loss_factor:.3f} +- {e.loss_factor_sd:.3f} at {e.frequency:.2f} +- {e.frequency_sd:.3f} Hz "
        f"(damping ratio {e.damping:.4f} +- {e.damping_sd:.4f}). {' '.join(e.notes)}",
    ]


def _prediction_remarks(recordings: dict[str, SiliconeRecording]) -> list[str]:
    over_time = "; ".join(
        f"{name} {early:.3f} in the first half of the swing, {late:.3f} in the second"
        for name, r in recordings.items()
        for early, late in [damping_over_time(r)]
    )
    clamp = {name: 1e3 * float(r.base_motion.max()) for name, r in recordings.items()}
    return [
        f"Missed: the damping of the loaded runs. Measured damping ratios: {over_time}. The predicted one falls with "
        "the frequency, as that of one Prony term fixed at 7.7 Hz must; the measured one rises and is not the same "
        "over a swing. A longer tau would let it rise (see the choices, 0.1 s) but then the beam would hang twice as "
        "low: real silicone relaxes at many times, and the hung mass and the clamp rub.",
        f"Missed: the first swing. The beam falls less far than one that is let go at once; frequencies are compared "
        f"from {SKIP:g} s after the release on. The hand does not vanish in an instant, least of all with a mass.",
        "Not perfect in the recordings: the clamp's markers move between held and rest by up to "
        + ", ".join(f"{mm:.1f} mm ({name})" for name, mm in clamp.items())
        + "; the same beam was set up anew for each, and pointed 6.5 to 7.5 degrees downward.",
        "The mass is a point mass on the upper edge of the tip face, where the authors' own simulation puts it (their "
        "code, not these recordings, decided this); the table of choices shows what another place would say: on the "
        "lower edge the drops would be missed by 11 and 16 %.",
    ]


def _twin_case(
    recordings: dict[str, SiliconeRecording], predictions: dict[str, list[Prediction]], material: Foam
) -> CaseResult:
    loops: list[Withheld] = []
    for name, recording in recordings.items():
        open_loop = next(p for p in predictions[name] if p.method == "cell")
        loops += leave_one_out(recording, material, open_loop)
    rows = [loop.row() for loop in loops]
    better = [float(row["open over closed"]) for row in rows]
    worst = max(float(row["closed loop %"]) for row in rows)
    verdicts = [
        Verdict(
            "a withheld tip marker, closed loop better than open loop",
            f"{min(better):.1f} to {max(better):.1f} times, median {np.median(better):.1f}; worst error {worst:.1f} % "
            "of the movement",
            "in every case",
            min(better) > 1.0,
        )
    ]
    remarks = [
        "Real recordings. Two of three tip markers are shown to the twin in every frame, the third is compared. Open "
        "and closed loop begin alike: straight and at rest at the release, with the material of the recording without "
        "a mass, the hung mass, and gravity. Two markers give six numbers, so the twin corrects five modes. Errors are "
        "distances in space, over all frames from the release on.",
        "With 101 g the error that is left hardly changes over time: the real tip turns by 25 degrees, the model's by "
        "20 (13.6 and 12.9 with 52 g, 5.1 and 4.7 without), because the mass pulls at the soft edge from in front of "
        "the face; two markers in five smooth modes cannot take all of that up.",
    ]
    return CaseResult(
        title="The twin of a real beam: one of three tip markers withheld",
        rows=rows,
        verdicts=verdicts,
        remarks=remarks,
        figure=twin_figure(loops),
    )


def _choices_case(free: SiliconeRecording, loaded: list[SiliconeRecording]) -> CaseResult:
    rows = [choice_row(choice, free, loaded) for choice in choices(free)]
    heads = dict.fromkeys(key for row in rows for key in row)
    rows = [{head: row.get(head) for head in heads} for row in rows]
    return CaseResult(
        title="What the characterisation takes for granted, varied",
        rows=rows,
        verdicts=[],
        remarks=[
            "Every line is a fit of its own to the recording without a mass and a prediction of the others (finite "
            "elements); drop and Hz are errors in percent. A refused line is a choice that no material fulfils.",
            "Poisson's ratio (the elements do not lock at 0.499) and the mesh hardly matter for what is predicted, as "
            "each fit takes up their part. At one Poisson ratio, one recording at one frequency fixes the storage "
            "modulus (within 2 %) and the loss factor; tau is not in it. What limits tau is the static shape: a slow "
            "one needs a beam that hangs much lower than was seen.",
        ],
        figure=choices_figure(rows),
    )


if __name__ == "__main__":
    sys.exit(main())
