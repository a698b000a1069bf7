"""Cases of the liquid's validation: what they compute from known input, what they write, how they fail."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp

from zsdt.errors import DataError, OptionError, RunRejected
from zsdt.evaluation import liquid_validation, real_water, real_water_runs, tank_checks
from zsdt.evaluation.liquid_checks import VESSELS, hydrostatic_errors, swirl
from zsdt.evaluation.liquid_report import CaseResult, Verdict, markdown_table, write_case
from zsdt.evaluation.real_water import compare, residual_mode
from zsdt.evaluation.real_water_runs import RecordedMotion, WaterRun
from zsdt.fluid.linear_theory import cylinder_modes, forced_response, highest_at_wall
from zsdt.fluid.sampling import fill
from zsdt.fluid.vessel import Vessel
from zsdt.interop.sloshing import CylinderRecording
from zsdt.scene import Liquid, VesselShape

LEAN = np.radians(20.0)


@pytest.fixture(scope="module")
def recording():
    """A recording made by linear theory: a shake along x and back, seen by a camera whose clock started 8 s before."""
    times = 0.002 * np.arange(2000)
    turn = np.clip((times - 1.0) / 2.0, 0.0, 1.0)
    x = 0.06 * np.sin(2.0 * np.pi * 2.0 * (times - 1.0)) * np.sin(np.pi * turn) ** 4
    position = np.stack([x, 0.3 * x, np.zeros_like(x)], axis=-1)
    made = CylinderRecording(
        name="LE_2D_made",
        times=times,
        position=position,
        quaternion=np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1)),
        video_times=np.arange(0.0, 20.0, 1.0 / 60.0),
        height=np.zeros(1200),
    )
    motion = made.kinematics(rest=5.0)
    surface = forced_response(cylinder_modes(0.049, 0.08), motion.times, motion.specific_force, None, 0.0043)
    made.height = 0.5e-3 + np.interp(made.video_times - 8.0, motion.times, highest_at_wall(surface), right=0.0)
    return made


def test_a_recording_that_is_linear_theory_is_met_by_it(recording):
    found = compare(recording, None)
    assert found.row["correlation of theory"] > 0.99
    assert found.row["measured peak mm"] == pytest.approx(found.row["linear peak mm"], rel=0.02)
    assert found.row["measured residual Hz"] == pytest.approx(3.05, rel=0.01)
    assert found.row["measured decay 1/s"] == pytest.approx(0.0043 * 19.15, rel=0.3)


def test_a_run_is_put_on_the_clock_of_the_recording(recording):
    theory = compare(recording, None)
    times = np.arange(0.0, theory.theory_times[-1], 1.0 / 60.0)
    height = np.interp(times, theory.theory_times, theory.theory)
    centroid = np.zeros((len(times), 3))
    centroid[:, :2] = 2e-3 * np.outer(np.exp(-0.4 * times) * np.sin(2.0 * np.pi * 2.9 * times), [0.6, 0.8])
    run = WaterRun(times, 0.9 * height, centroid, 100, 0.01, 0, 0, 0.0)
    row = compare(recording, run).row
    assert row["sph peak mm"] == pytest.approx(0.9 * row["linear peak mm"], rel=0.02)
    assert row["correlation of sph"] > 0.99
    assert row["sph residual Hz"] == pytest.approx(2.9, rel=0.005)
    assert row["sph decay 1/s"] == pytest.approx(0.4, rel=0.05)
    assert residual_mode(WaterRun(times, height, np.zeros((len(times), 3)), 100, 0.01, 0, 0, 0.0), 1.0) is None


def test_recorded_motion_moves_a_loose_particle_along_a_straight_line_in_the_room():
    """A force-free particle in the axes of a glass that leans and slides: all inertial forces and their signs."""
    from scipy.spatial.transform import Rotation

    times = 0.002 * np.arange(1001)
    ramp = np.clip((times - 0.2) / 1.4, 0.0, 1.0)
    angle = LEAN * np.sin(np.pi * ramp) ** 4
    axes = Rotation.from_rotvec(np.outer(angle, [0.6, 0.8, 0.0]))
    position = np.stack([0.2 * ramp**4 * (1 - ramp) ** 4 * 100, np.zeros_like(ramp), 0.1 * angle], axis=-1)
    made = CylinderRecording("Tilt", times, position, axes.as_quat(), times, np.zeros_like(times))
    motion = RecordedMotion(made.kinematics())

    def rate(t, state):
        x, v = state[:3], state[3:]
        omega, alpha = motion.angular_velocity(t), motion.angular_acceleration(t)
        inertial = -motion.acceleration(t) - np.cross(alpha, x) - np.cross(omega, np.cross(omega, x))
        return np.concatenate([v, inertial - 2.0 * np.cross(omega, v) + motion.gravity(t)])

    start = np.array([0.02, -0.01, 0.05, 0.3, 0.1, 0.0])
    state = solve_ivp(rate, (0.0, 1.9), start, rtol=1e-8, atol=1e-10, max_step=0.004).y[:, -1]
    in_room = axes[950].apply(state[:3]) + position[950]
    expected = start[:3] + 1.9 * start[3:] - [0.0, 0.0, 0.5 * 9.81 * 1.9**2]
    np.testing.assert_allclose(in_room, expected, atol=3e-3)


def test_runs_are_kept_and_refusals_are_told(tmp_path, monkeypatch, recording):
    calls = []

    class FakeBasin:
        def __init__(self, *_):
            pass

        def simulate(self, kinematics):
            calls.append(1)
            if len(calls) > 1:
                raise RunRejected("mach", "A particle is too fast; use a gentler motion.")
            times = np.arange(0.0, kinematics.times[-1], 1.0 / 60.0)
            centroid = np.zeros((len(times), 3))
            centroid[:, 0] = 1e-3 * np.sin(2.0 * np.pi * 3.0 * times)
            return WaterRun(times, 0.02 * np.abs(np.sin(19.0 * times)), centroid, 100, 0.01, 0, 0, 0.0)

    monkeypatch.setattr(real_water_runs, "Basin", FakeBasin)
    for module in (real_water, real_water_runs):
        monkeypatch.setattr(module, "read_cylinder", lambda name: recording)
    for _ in range(2):
        run = real_water_runs.run_recording("first", tmp_path, 100, 10.0)
    assert len(calls) == 1 and run.particles == 100
    result = real_water.cylinder_case(["first", "second"], tmp_path, 100, 10.0)
    assert not result.verdicts[0].passed  # two recordings are not six
    assert any("second: the solver refused (mach)" in remark for remark in result.remarks)
    paths = write_case(tmp_path, "cylinder", "made by hand", result)
    assert all(path.stat().st_size > 0 for path in paths)
    with pytest.raises(DataError, match="Not one recording"):
        real_water.cylinder_case(["second"], tmp_path, 100, 10.0)


def test_reports_hold_the_verdicts_and_the_command(tmp_path):
    verdicts = [Verdict("error", "3.1 %", "at most 4 %", True), Verdict("drift", "9 %", "at most 1 %", False)]
    result = CaseResult("A case", [{"a": 1, "b": 0.123456}, {"a": 2, "b": None}], verdicts, ["A remark."], Figure())
    write_case(tmp_path, "case", "python -m something", result)
    page = (tmp_path / "case.md").read_text()
    for expected in (
        "python -m something",
        "PASS: error: 3.1 %",
        "FAIL: drift",
        "| 1 | 0.1235 |",
        "| 2 | - |",
        "A remark",
    ):
        assert expected in page
    assert (tmp_path / "case.csv").read_text().startswith("a,b\n1,0.123456\n")
    assert markdown_table(result.rows).count("\n") == 3
    with pytest.raises(DataError, match="no rows"):
        write_case(tmp_path, "empty", "x", CaseResult("E", [], [], [], Figure()))


def test_command_line_writes_and_returns_the_verdict(tmp_path, monkeypatch, capsys):
    for passed, status in ((True, 0), (False, 1)):
        result = CaseResult("A case", [{"a": 1}], [Verdict("error", "1 %", "4 %", passed)], [], Figure())
        monkeypatch.setitem(liquid_validation._CASES, "viscous", lambda chosen, result=result: result)
        assert liquid_validation.main(["viscous", str(tmp_path)]) == status
    assert "FAIL: error" in capsys.readouterr().out
    assert "python -m zsdt.evaluation.liquid_validation viscous" in (tmp_path / "viscous.md").read_text()

    def broken(chosen):
        raise DataError("There is no file; fetch it.")

    monkeypatch.setitem(liquid_validation._CASES, "viscous", broken)
    assert liquid_validation.main(["viscous", str(tmp_path)]) == 2
    assert "There is no file" in capsys.readouterr().err


def test_the_five_vessels_hold_five_centimetres():
    assert set(VESSELS) == {"cylinder", "tumbler", "bowl", "flask", "jar"}
    for name, shape in VESSELS.items():
        assert shape.family.value == name
        assert shape.rim > 0.07


def test_hydrostatics_of_a_small_glass():
    vessel = Vessel(VesselShape(heights=[0.0, 0.08], radii=[0.025, 0.025]))
    found = hydrostatic_errors(vessel, Liquid(), fill(vessel, 0.035, 250, np.random.default_rng(0)), settle=0.2)
    assert found.pressure_error < 0.05
    assert found.density_error < 0.005


def test_swirl_of_glycerin_decays_as_it_should():
    decay = swirl(500)
    assert decay.rate == pytest.approx(decay.exact, rel=0.06)


def test_a_column_falls_no_faster_than_shallow_water_theory():
    run = tank_checks.collapse(across=8, until=1.2)
    assert np.all(np.diff(run.front) > -0.02)
    assert run.front[0] == pytest.approx(1.0, abs=0.02)
    assert 1.2 < run.front[-1] < 1.0 + 2.0 * run.time[-1]  # dry-bed front: twice the speed of waves, here 2 sqrt(2 g a)
    with pytest.raises(OptionError, match="8 particles"):
        tank_checks.collapse(across=4)
