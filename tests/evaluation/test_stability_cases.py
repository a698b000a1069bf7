"""Hard cases: what must be rejected is, with its reason; what is spoilt comes back; the table tells which is worst."""

import math
import time

import numpy as np
import pytest

from zsdt.errors import OptionError
from zsdt.evaluation.stability_beam_cases import BeamCase, Course
from zsdt.evaluation.stability_registry import CASES, Job, StabilityOptions, jobs_of, known_row, limited, run_job
from zsdt.evaluation.stability_row import Outcome, Party, Row, books, read_row, write_row
from zsdt.evaluation.stability_table import judge, normal_errors, worst_first


def row_of(name, party, tmp_path):
    job = Job(CASES[name], party, None, 60.0)
    run_job(job, str(tmp_path))
    return known_row(tmp_path, job)


def test_a_state_that_is_no_number_is_rejected_by_solver_and_network_and_survived_by_the_twin(tmp_path):
    for party in (Party.solver, Party.network):
        row = row_of("nan_state", party, tmp_path)
        assert row.outcome == Outcome.rejected and row.reason.startswith("not_finite")
    case = CASES["nan_state"]
    row = row_of("nan_state", Party.twin, tmp_path)
    assert row.outcome == Outcome.bounded and row.note == "1 restarts"
    assert np.isfinite(row.error).all() and len(row.error) == case.frames
    assert max(row.error[case.spoilt_frame + 5 :]) < 0.005  # of the length


def test_a_network_says_that_its_cells_collapsed_under_a_load_that_the_solver_refuses(tmp_path):
    for party in (Party.solver, Party.network):
        row = row_of("load_10x", party, tmp_path)
        assert row.outcome == Outcome.rejected and row.reason.startswith("collapse"), row


def test_the_solver_closes_its_books_and_the_network_stays_near_it_when_a_load_is_let_go(tmp_path):
    solver, network = (row_of("normal_release", party, tmp_path) for party in (Party.solver, Party.network))
    assert solver.energy_growth < 1e-5 and network.energy_growth < 1e-3
    assert solver.entropy_min >= 0.0 and network.entropy_min >= 0.0
    assert max(network.error) < 0.002


def test_forces_of_a_case_are_what_it_says():
    points = np.stack(np.meshgrid([0.0, 0.1, 0.2], [0.0, 0.1], [0.0, 0.1], indexing="ij"), axis=-1).reshape(-1, 3)
    for name, total, couple in (("normal_hand", -3.0, 0.0), ("off_axis", -3.0, -0.15), ("twist", 0.0, -0.3)):
        force = CASES[name].force(points)
        turning = (points[:, 1] - 0.05) * force[:, 2]
        assert np.allclose(force.sum(axis=0), [0.0, 0.0, total]) and math.isclose(turning.sum(), couple, abs_tol=1e-12)
    assert np.count_nonzero(BeamCase("", "", course=Course.impulse).factors()) == 1


def test_books_find_energy_from_nowhere_and_cold_and_forgive_a_restart():
    work = np.linspace(0.0, 1.0, 11)
    heat = 0.5 * work
    account = {"kinetic": 0.5 * work, "elastic": 0.0 * work, "dissipated": heat, "work_of_ports": work}
    assert books(account) == pytest.approx((0.0, 0.1))
    account["kinetic"] = account["kinetic"] + 0.2 * (np.arange(11) >= 6)
    growth, least = books(account)
    assert growth == pytest.approx(0.2, rel=0.01) and least == pytest.approx(0.1)
    assert books(account, restarts=[6])[0] == pytest.approx(0.0, abs=1e-12)
    account["dissipated"] = np.where(np.arange(11) == 5, 0.0, heat)
    assert books(account)[1] < -0.3


def row(case, error, flags=None, outcome=Outcome.bounded, party="twin"):
    return Row(case, "beam", party, outcome, "", len(error), list(error), flags=flags)


def test_a_wrong_stress_counts_though_the_place_is_right():
    rows = [row("normal_hand", [1.0] * 9), row("x", [1.0] * 9)]
    rows[0].hidden, rows[1].hidden = [0.1] * 9, [0.1] * 4 + [0.5] * 5
    judged = judge(rows, ["normal_hand"])[1]
    assert judged.first_3x == 4 and judged.worst == pytest.approx(5.0) and judged.verdict == "silent"


def test_verdicts_and_their_order():
    rows = [
        row("normal_hand", [1.0] * 100),
        row("quiet", [1.0, 2.9]),
        row("silent", [1.0, 3.1, 9.0], ["", "", ""]),
        row("late", [1.0, 3.1, 9.0], ["", "", "range"]),
        row("flagged", [1.0, 3.1, 9.0], ["", "range", ""]),
        row("gone", [1.0, math.nan], outcome=Outcome.failed),
        row("other party", [100.0], party="network"),
    ]
    assert normal_errors(rows, ["normal_hand"]) == {("beam", "twin", "error"): 1.0}
    judged = judge(rows, ["normal_hand"])
    assert [j.verdict for j in judged] == ["bounded", "bounded", "silent", "late", "flagged", "failed", "bounded"]
    assert judged[2].first_3x == 1 and judged[3].first_flag == 2
    assert [j.row.case for j in worst_first(judged)][:3] == ["gone", "silent", "late"]
    assert math.isnan(judged[-1].worst)  # of a party whose normal error nobody knows


def test_a_row_is_kept_with_its_gaps(tmp_path):
    kept = row("x", [0.5, math.nan], ["", "range"])
    write_row(tmp_path / "row.json", kept)
    back = read_row(tmp_path / "row.json")
    assert back.error[0] == 0.5 and math.isnan(back.error[1]) and back.flags == ["", "range"]
    assert math.isnan(back.energy_growth)


def test_a_hang_and_a_crash_are_rows_and_not_the_end(tmp_path, monkeypatch):
    from zsdt.evaluation import stability_registry as registry

    def hang(job, folder):
        while True:
            pass

    monkeypatch.setattr(registry, "_run", hang)
    job = Job(CASES["impulse"], Party.network, None, 0.2)
    assert run_job(job, str(tmp_path))["reason"].startswith("hang")
    monkeypatch.setattr(registry, "_run", lambda job, folder: time.sleep(30.0))  # waits without computing anything
    monkeypatch.setattr(registry, "WAIT", 1.0)
    assert run_job(job, str(tmp_path))["reason"].startswith("hang")
    monkeypatch.setattr(registry, "_run", lambda job, folder: 1 / 0)
    assert run_job(job, str(tmp_path)) == {"outcome": "failed", "reason": "crash: ZeroDivisionError: division by zero"}
    with limited(5.0):
        pass  # and nothing is left ticking


def test_names_are_unique_and_a_wrong_one_is_named():
    assert len({case.name for case in CASES.values()}) == len(CASES)
    with pytest.raises(OptionError, match="no hard case 'nothing'"):
        StabilityOptions(cases=["nothing"])
    parties = {job.party for job in jobs_of(StabilityOptions(cases=["noise", "impulse"]))}
    assert parties == {Party.solver, Party.network, Party.twin}  # cameras and the seed's form only where there are any
