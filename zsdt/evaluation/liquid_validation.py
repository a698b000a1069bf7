"""Checks of the liquid's ground truth against theory and real recordings, one case a time.

`python -m zsdt.evaluation.liquid_validation CASE OUT` writes CASE.csv, CASE.md and CASE.png below OUT and says whether
the required figures are met (exit status 1 where not). Runs of the case `cylinder` are kept below OUT/runs, so that
a run that was stopped goes on where it was.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from zsdt.errors import RunRejected, ZsdtError
from zsdt.evaluation.liquid_checks import frequency_case, hydrostatics_case, viscous_case
from zsdt.evaluation.liquid_report import CaseResult, write_case
from zsdt.evaluation.real_water import REPRESENTATIVE, cylinder_case
from zsdt.evaluation.real_water_runs import run_recording
from zsdt.evaluation.tank_checks import faltinsen_case, martin_moyce_case
from zsdt.interop.sloshing import recording_names

_CASES: dict[str, Callable[[argparse.Namespace], CaseResult]] = {
    "hydrostatics": lambda chosen: hydrostatics_case(),
    "frequency": lambda chosen: frequency_case(),
    "viscous": lambda chosen: viscous_case(),
    "martin_moyce": lambda chosen: martin_moyce_case(),
    "faltinsen": lambda chosen: faltinsen_case(),
    "cylinder": lambda chosen: _cylinder(chosen),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; the exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    parser = _parser()
    chosen = parser.parse_args(given)
    command = "python -m zsdt.evaluation.liquid_validation " + shlex.join(given)
    try:
        if chosen.case == "cylinder" and chosen.only:
            return _one_run(chosen)
        result = _CASES[chosen.case](chosen)
        write_case(chosen.out, chosen.case, command, result)
    except ZsdtError as error:
        print(f"{chosen.case}: {error}", file=sys.stderr)
        return 2
    for verdict in result.verdicts:
        print(verdict.line())
    return 0 if all(v.passed for v in result.verdicts) else 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("case", choices=tuple(_CASES))
    parser.add_argument("out", type=Path, help="folder for the results")
    parser.add_argument("--particles", type=int, default=2000, help="cylinder: particles of a run")
    parser.add_argument("--sound-speed", type=float, default=10.0, help="cylinder: reference speed of sound [m/s]")
    parser.add_argument("--recordings", nargs="*", help="cylinder: names, or 'all'; one of every kind if not given")
    parser.add_argument("--only", help="cylinder: just make the run of this recording, write no report")
    return parser


def _cylinder(chosen: argparse.Namespace) -> CaseResult:
    names = chosen.recordings or list(REPRESENTATIVE)
    names = recording_names() if names == ["all"] else names
    return cylinder_case(names, chosen.out / "runs", chosen.particles, chosen.sound_speed)


def _one_run(chosen: argparse.Namespace) -> int:
    try:
        run = run_recording(chosen.only, chosen.out / "runs", chosen.particles, chosen.sound_speed)
    except RunRejected as refusal:
        print(f"{chosen.only}: refused ({refusal.cause}): {refusal}", file=sys.stderr)
        return 3
    print(f"{chosen.only}: peak {1e3 * run.highest.max():.1f} mm, {run.guards} guard contacts, {run.spilled} spilled")
    return 0


if __name__ == "__main__":
    sys.exit(main())
