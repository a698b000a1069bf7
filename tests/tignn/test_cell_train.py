"""Training of the sub-step form from end to end, on data that a known cell energy made."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from tests.tignn.cell_bodies import body_of, write_cell_beams
from zsdt.errors import DataError
from zsdt.tignn.cell_energy import CellOptions, card_of, nominal_constants
from zsdt.tignn.cell_engine import CellEngine
from zsdt.tignn.cell_train import train_cell
from zsdt.tignn.engine import load_engine, roll_out
from zsdt.tignn.options import Form, TignnOptions, TrainingOptions
from zsdt.trajectory import Trajectory, write_index

FRAMES = 25


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    cases = [
        ("train", (4, 2, 2), "dynamic", 0.6),
        ("train", (5, 2, 2), "hand", 0.3),
        ("val", (4, 2, 3), "dynamic", 0.8),
        ("train", (4, 1, 1), "hand", -2.0),
    ]
    return write_cell_beams(tmp_path_factory.mktemp("cells"), cases, FRAMES)


def test_training_finds_the_motion_says_what_it_left_out_and_resumes(dataset, tmp_path):
    cell = CellOptions(fit_iterations=3, fit_every=3, correction=True, hidden=2)
    options = TignnOptions(form=Form.cell, cell=cell)
    result = train_cell(dataset, options, TrainingOptions(), tmp_path / "out", tmp_path / "scratch")
    stages = {row["stage"]: row for row in result["stages"]}
    assert list(stages) == ["start", "statics", "motion", "boundary", "correction", "readout"]
    assert stages["start"]["displacement"] > 0.2
    assert stages["readout"]["displacement"] < 0.05
    assert result["left_out"] == ["beam_3"]
    with (tmp_path / "out" / "training.csv").open() as lines:
        assert len(list(csv.DictReader(lines))) == len(result["stages"])
    again = train_cell(dataset, options, TrainingOptions(), tmp_path / "again", tmp_path / "scratch")
    assert again["constants"] == result["constants"]
    assert (tmp_path / "again" / "stages" / "motion" / "engine.json").is_file()
    brief = TignnOptions(form=Form.cell, cell=replace(cell, fit_iterations=1, boundary=False, readout=False))
    brief.cell.correction = False
    warm = train_cell(dataset, brief, TrainingOptions(), tmp_path / "warm", tmp_path / "other", tmp_path / "out")
    assert warm["stages"][0]["displacement"] == pytest.approx(stages["correction"]["displacement"], rel=1e-6)


def test_a_known_card_makes_a_softer_foam_predictable(dataset):
    """Zero-shot to another material: learned on one card, moduli scale with the ratio of the cards."""
    body = body_of((4, 2, 2), frame_dt=0.005)
    learned = nominal_constants(*card_of(body))
    learned.card = card_of(body)
    body.material.young, body.material.tau = 2.5e4, 0.08
    load = np.zeros((FRAMES, body.nodes, 3))
    load[1:, -1, 2] = -0.2
    fields = {"position": np.repeat(body.points[None], FRAMES, 0), "velocity": np.zeros((FRAMES, body.nodes, 3))}
    data = Trajectory(body, np.arange(FRAMES) * body.frame_dt, fields, load)
    ours = roll_out(CellEngine(learned), data).fields["stress"]
    known = roll_out(CellEngine(nominal_constants(*card_of(body))), data).fields["stress"]
    np.testing.assert_allclose(ours, known, rtol=1e-9, atol=1e-6)


def test_without_train_beams_there_is_one_sentence(tmp_path):
    write_index(tmp_path, [])
    with pytest.raises(DataError, match="no train trajectories"):
        train_cell(tmp_path, TignnOptions(form=Form.cell), TrainingOptions(), tmp_path / "o", tmp_path / "s")


def test_artifact_of_the_training_is_an_engine(dataset, tmp_path):
    cell = CellOptions(fit_iterations=1, fit_every=6, boundary=False, readout=False)
    train_cell(dataset, TignnOptions(form=Form.cell, cell=cell), TrainingOptions(), tmp_path / "o", tmp_path / "s")
    assert load_engine(tmp_path / "o").options == cell
