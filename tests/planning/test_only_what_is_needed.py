"""A twin imports the rooms of its own scene and no others: asked in a process of its own, with the shipped weights."""

import subprocess
import sys

import pytest

BEAM = """
from zsdt.perception.segmentation import load_segmenter
from zsdt.planning.budget import Budget
from zsdt.planning.choices import with_cadence
from zsdt.planning.planner import plan_beam
from zsdt.shipped import shipped
from zsdt.tignn.engine import load_engine
from zsdt.twin.loop import TwinOptions, run_twin
from zsdt.twin.twin_scene import BeamTwinScene
plan = plan_beam(BeamTwinScene(planar=True, fields=["velocity"]), Budget(frame_ms=1e3, speed=1.0))
with_cadence(TwinOptions(), plan.choice)
load_segmenter(shipped("foam_beam", "vision"))
load_engine(shipped("foam_beam", "tignn"))
"""
GLASS = """
from zsdt.perception.glass_segmentation import load_glass_segmenter
from zsdt.planning.budget import Budget
from zsdt.planning.choices import with_cadence
from zsdt.planning.planner import plan_glass
from zsdt.shipped import shipped
from zsdt.tignn.engine import load_engine
from zsdt.tignn.psi_ini_liquid import load
from zsdt.twin.glass_loop import GlassTwinOptions, run_glass_twin
from zsdt.twin.glass_scene import GlassTwinScene
plan = plan_glass(GlassTwinScene(), Budget(frame_ms=1e4, speed=1.0))
with_cadence(GlassTwinOptions(), plan.choice)
load_glass_segmenter(shipped("glycerin_glass", "vision"))
plan.choice.engine(load_engine(shipped("glycerin_glass", "tignn")))
load(shipped("glycerin_glass", "psi_ini"))
"""
NOBODY = (  # what no running twin needs: the lab, judges, drawing, training, other people's files
    "zsdt.lab", "zsdt.evaluation", "zsdt.interop", "zsdt.workers", "mitsuba", "openvino", "matplotlib", "lightning",
    "rerun", "hydra", "omegaconf", "zsdt.tignn.train", "zsdt.tignn.node_engine", "zsdt.tignn.liquid_engine",
    "zsdt.tignn.seed_engine", "zsdt.tignn.model",
)  # fmt: skip
NAMES = {"zsdt.evaluation", "zsdt.evaluation.ledger"}  # of energies, by which every frame's account is audited
ONLY_GLASS = (
    "zsdt.fluid", "zsdt.radius_graph", "zsdt.tignn.particle_engine", "zsdt.tignn.psi_ini_liquid",
    "zsdt.perception.glass_segmentation", "zsdt.perception.glass_geometry", "zsdt.perception.free_surface",
    "zsdt.twin.glass_loop", "zsdt.twin.glass_twin", "zsdt.twin.liquid_assimilation",
)  # fmt: skip
ONLY_BEAM = (
    "zsdt.solid", "zsdt.tignn.cell_engine", "zsdt.tignn.psi_ini", "zsdt.perception.grid_graph",
    "zsdt.perception.optical_flow", "zsdt.twin.loop", "zsdt.twin.beam_twin", "zsdt.twin.modes",
)  # fmt: skip


def imported_by(program):
    """Names of all modules that a program has imported when it ends."""
    program += "\nimport sys; print('|'.join(sys.modules))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]
    return set(done.stdout.strip().splitlines()[-1].split("|"))


def among(modules, names):
    return sorted(m for m in modules if any(m == n or m.startswith(f"{n}.") for n in names))


@pytest.mark.parametrize(
    ("program", "own", "others"), [(BEAM, ("zsdt.twin.loop",), ONLY_GLASS), (GLASS, ("zsdt.fluid",), ONLY_BEAM)]
)
def test_a_twin_imports_no_room_of_another_scene(program, own, others):
    modules = imported_by(program)
    assert among(modules, own)  # the question is asked of the right process
    assert set(among(modules, NOBODY)) <= NAMES
    assert among(modules, others) == []
