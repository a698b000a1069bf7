"""The real silicone beam, end to end: material from one recording, the others predicted, a marker withheld."""

from dataclasses import replace

import numpy as np
import pytest

from zsdt.evaluation.liquid_report import write_case
from zsdt.evaluation.silicone import compare, held_state, material_of, predict_cell, predict_fem, twin_engine
from zsdt.evaluation.silicone_choices import choice_row, choices
from zsdt.evaluation.silicone_report import _prediction_case
from zsdt.evaluation.silicone_twin import Withheld, closed_loop
from zsdt.files import data_root
from zsdt.interop.silicone_beam import read_silicone
from zsdt.solid.prony import PronyChoice

pytestmark = pytest.mark.skipif(
    not (data_root() / "silicone_beam").is_dir(), reason="the silicone data are not here (ZSDT_DATA)"
)


@pytest.fixture(scope="module")
def estimate():
    return material_of(read_silicone("gravity"))


@pytest.fixture(scope="module")
def heavy():
    return read_silicone("load52")


@pytest.fixture(scope="module")
def open_loop(estimate, heavy):
    return predict_cell(heavy, estimate.material)


def test_the_material_is_near_what_the_authors_found(estimate):
    assert estimate.static_young == pytest.approx(263.8e3, rel=0.03)
    assert estimate.material.young == pytest.approx(263.8e3, rel=0.05)
    assert estimate.storage_young > estimate.relaxed_young
    assert estimate.frequency == pytest.approx(7.74, abs=0.05)


def test_drop_and_frequency_with_a_mass_are_predicted_from_the_run_without(estimate, heavy, open_loop):
    for prediction in (predict_fem(heavy, estimate.material), open_loop):
        row = compare(heavy, prediction)
        assert abs(row["drop error %"]) < 10 and abs(row["Tip-1 drop error %"]) < 10
        assert abs(row["frequency error %"]) < 5


def test_the_hung_mass_weighs_in_the_engine(estimate, heavy):
    engine = twin_engine(heavy, estimate.material)
    held = held_state(engine)
    assert np.linalg.norm(engine.weight.sum(axis=0)) == pytest.approx(9.81 * (1070.0 * 9e-5 + 0.052), rel=1e-6)
    assert engine.inertia.sum() == pytest.approx(1070.0 * 9e-5 + 0.052, rel=1e-6)
    assert np.abs(held.u).max() == 0.0


def test_a_withheld_marker_is_followed_better_than_by_the_open_loop(estimate, heavy, open_loop):
    moved = closed_loop(heavy, estimate.material, [1, 2], open_loop.rest)
    seen = heavy.displacement[heavy.release :]
    row = Withheld(heavy, 0, moved[:, 0], seen[:, 0], open_loop.displacement[:, 0]).row()
    assert row["open over closed"] > 2
    assert row["closed loop %"] < 10


def test_a_choice_that_no_material_fulfils_is_a_row_with_its_reason(heavy):
    free = read_silicone("gravity")
    default = choices(free)[0]
    slow = replace(default, options=replace(default.options, prony=PronyChoice.given_tau, tau=100.0))
    assert choice_row(slow, free, [heavy])["refused"] == "damping"


def test_the_case_is_written_with_its_verdicts(estimate, heavy, open_loop, tmp_path):
    case = _prediction_case({"load52": heavy}, {"load52": [open_loop]}, estimate)
    paths = write_case(tmp_path, "silicone_prediction", "command", case)
    assert all(path.stat().st_size > 500 for path in paths)
    assert len(case.verdicts) == 2 and all(verdict.passed for verdict in case.verdicts)
