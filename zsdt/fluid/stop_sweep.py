"""Random vessels, levels and stops in the whole advertised range, and whether the walls held: leaks, guard contacts.

`python -m zsdt.fluid.stop_sweep FOLDER --cases 100 --liquid glycerin --workers 2` makes the runs (or goes on with them)
and prints what came out; it exits with 1 if a particle leaked, or if the guard at the wall had to help in a thick
liquid.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zsdt.errors import ZsdtError
from zsdt.fluid.dataset import generate
from zsdt.fluid.excitations import MotionOptions
from zsdt.fluid.sampler import LiquidSynthesisOptions
from zsdt.fluid.watch import VISCOUS
from zsdt.scene import Liquid, water
from zsdt.trajectory import Dataset, Trajectory


def sweep_options(liquid: Liquid, cases: int, particles: tuple[int, int] = (400, 600)) -> LiquidSynthesisOptions:
    """Every family in turn, stops at once and over 20-30 ms up to the highest speed, pulses and tilts among them."""
    thick = liquid.viscosity >= VISCOUS
    motion = MotionOptions(
        speed=[0.2, 1.0 if thick else 0.5], ramp=[0.02, 0.03], at_once=0.4, pulse_fraction=0.2, tilt_fraction=0.1
    )
    beyond = cases // 5
    return LiquidSynthesisOptions(
        train=cases - beyond,
        val=0,
        test=0,
        beyond=beyond,
        particles=list(particles),
        liquid=liquid,
        motion=motion,
        seed=30,
    )


@dataclass
class Census:
    """What happened at the walls over a data set.

    runs; leaks, guards: particles in the wall in any frame, contacts with the guard, over all runs; leaking, guarded:
    runs with any; rejected: cause -> number of cases that were drawn again; mach, density, residual: largest speed
    over that of sound, deviation of a density, error of the balance over the largest kinetic energy; at_once: runs
    that were stopped so; fastest: highest speed [m/s].
    """

    runs: int
    leaks: int
    leaking: int
    guards: int
    guarded: int
    rejected: dict[str, int]
    mach: float
    density: float
    residual: float
    at_once: int
    fastest: float

    def lines(self) -> list[str]:
        """For a person."""
        rejected = ", ".join(f"{n} {cause}" for cause, n in self.rejected.items()) or "none"
        return [
            f"{self.runs} runs, {self.at_once} of them stopped at once, up to {self.fastest:.2f} m/s",
            f"leaked particles: {self.leaks} (in {self.leaking} runs)",
            f"contacts with the guard: {self.guards} (in {self.guarded} runs)",
            f"cases rejected and drawn again: {rejected}",
            f"largest speed {self.mach:.3f} of that of sound, density {100 * self.density:.2f} % off, "
            f"balance {100 * self.residual:.2f} % of the kinetic energy",
        ]


def census(folder: str | Path) -> Census:
    """Counts over all trajectories of a data set of liquids.

    Raises: DataError where the folder holds none.
    """
    data = Dataset(folder)
    cards = [_card(data.read(entry)) for entry in data.entries]

    def highest(name: str) -> float:
        return max((card[name] for card in cards), default=0.0)

    return Census(
        runs=len(cards),
        leaks=sum(c["leaks"] for c in cards),
        leaking=sum(c["leaks"] > 0 for c in cards),
        guards=sum(c["guards"] for c in cards),
        guarded=sum(c["guards"] > 0 for c in cards),
        rejected=dict(Counter(cause for c in cards for cause in c["rejected"])),
        mach=highest("mach"),
        density=highest("density"),
        residual=highest("residual"),
        at_once=sum(c["ramp"] == 0.0 for c in cards),
        fastest=highest("speed"),
    )


def _card(trajectory: Trajectory) -> dict[str, Any]:
    meta, ledger = trajectory.meta, trajectory.ledger
    wanted = {name: meta[name] for name in ("leaks", "guards", "rejected")}
    residual = float(np.abs(ledger["residual"]).max() / ledger["kinetic"].max())
    return {
        **wanted,
        **meta["watched"],
        "residual": residual,
        "ramp": meta["stop"]["ramp"],
        "speed": meta["stop"]["speed"],
    }


def main(words: list[str] | None = None) -> int:
    """Command line; one clear sentence where something is missing."""
    parser = argparse.ArgumentParser(prog="python -m zsdt.fluid.stop_sweep", description=str(__doc__).splitlines()[0])
    parser.add_argument("folder", type=Path, help="where the runs are kept")
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--liquid", choices=("glycerin", "water"), default="glycerin")
    parser.add_argument("--particles", type=int, nargs=2, default=(400, 600), metavar=("LEAST", "MOST"))
    parser.add_argument("--workers", type=int, default=1)
    chosen = parser.parse_args(words)
    liquid = Liquid() if chosen.liquid == "glycerin" else water()
    try:
        options = sweep_options(liquid, chosen.cases, tuple(chosen.particles))
        figures = generate(options, chosen.folder, chosen.workers)
        found = census(chosen.folder)
    except ZsdtError as error:
        print(error, file=sys.stderr)
        return 2
    print("\n".join(found.lines()))
    print(f"{figures['cpu_s']:.0f} CPU-s, {figures['peak_worker_mb']:.0f} MB in the largest worker")
    held = found.leaks == 0 and "leak" not in found.rejected and (found.guards == 0 or liquid.viscosity < VISCOUS)
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())
