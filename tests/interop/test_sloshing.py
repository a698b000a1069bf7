"""Readers of real sloshing: the motion's derivatives give the motion back, clocks are found, faults are named."""

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from zsdt.errors import DataError
from zsdt.files import data_root
from zsdt.fluid.linear_theory import cylinder_modes, forced_response, highest_at_wall
from zsdt.interop.sloshing import (
    CYLINDER_DEPTH,
    CYLINDER_RADIUS,
    align,
    faltinsen,
    martin_moyce,
    read_cylinder,
    recording_names,
    residual_oscillation,
)

have_cylinder = pytest.mark.skipif(
    not (data_root() / "sloshing_cylinder").is_dir(),
    reason="no data folder with sloshing_cylinder beside the repository",
)
have_digitised = pytest.mark.skipif(
    not (data_root() / "sloshing_digitised").is_dir(),
    reason="no data folder with sloshing_digitised beside the repository",
)


@have_cylinder
@pytest.mark.parametrize("name", ["LE_3D_0m_5.3s_900deg", "Tilt_TRD_3D_0.3m_2.5s_30deg"])
def test_derivatives_integrate_to_the_recorded_motion(name):
    recording = read_cylinder(name)
    motion = recording.kinematics()
    step = motion.times[1]
    axes = [np.eye(3)]
    for before, after in zip(motion.angular_velocity[:-1], motion.angular_velocity[1:], strict=True):
        axes.append(axes[-1] @ Rotation.from_rotvec(0.5 * step * (before + after)).as_matrix())
    np.testing.assert_allclose(np.stack(axes)[:, 2], -motion.gravity / 9.81, atol=2e-3)
    acceleration = np.einsum("tij,tj->ti", np.stack(axes), motion.acceleration)
    velocity = cumulative_trapezoid(acceleration, dx=step, axis=0, initial=0.0)
    position = cumulative_trapezoid(velocity, dx=step, axis=0, initial=0.0)
    assert np.abs(position - (recording.position - recording.position[0])).max() < 2e-3
    turned = cumulative_trapezoid(motion.angular_acceleration, dx=step, axis=0, initial=0.0)
    np.testing.assert_allclose(turned, motion.angular_velocity, atol=0.02)


@have_cylinder
def test_every_recording_reads_and_rests_under_gravity():
    names = recording_names()
    assert len(names) == 21
    for name in names:
        recording = read_cylinder(name)
        np.testing.assert_allclose(np.linalg.norm(recording.quaternion, axis=1), 1.0, atol=1e-12)
        begin, end = recording.span()
        assert 0.9 < begin < 1.3 and end - begin > 2.0
        motion = recording.kinematics(start=begin - 0.1, rest=1.0)
        np.testing.assert_allclose(np.linalg.norm(motion.gravity, axis=1), 9.81, atol=1e-9)
        np.testing.assert_allclose(motion.specific_force[0], [0.0, 0.0, 9.81], atol=1e-2)
        np.testing.assert_allclose(motion.acceleration[-100:], 0.0, atol=1e-6)


@have_cylinder
def test_spin_about_the_own_axis_is_left_out_and_tilt_stays():
    assert np.abs(read_cylinder("LE_2D_0m_5s_900deg").kinematics().angular_velocity).max() < 1e-6
    tilted = read_cylinder("Tilt_RD_2D_0.3m_7s_30deg").kinematics()
    assert np.degrees(np.arccos(-tilted.gravity[:, 2] / 9.81)).max() == pytest.approx(30.0, abs=0.1)
    as_read, as_written = (
        read_cylinder("Tilt_TRD_2D_0.3m_3.5s_30deg", as_written=w).kinematics() for w in (False, True)
    )
    np.testing.assert_allclose(as_read.gravity[:, :2], -as_written.gravity[:, :2], atol=1e-9)


@have_cylinder
def test_linear_theory_meets_a_gentle_recording():
    recording = read_cylinder("Tilt_LE_2D_0m_7s_30deg")
    begin, end = recording.span()
    motion = recording.kinematics(start=begin, rest=1.0)
    modes = cylinder_modes(CYLINDER_RADIUS, CYLINDER_DEPTH)
    model = highest_at_wall(
        forced_response(modes, motion.times, motion.specific_force, motion.angular_acceleration, 0.006)
    )
    shift, correlation = align(recording.video_times, recording.height, motion.times, model)
    assert correlation > 0.95
    during = (recording.video_times > shift) & (recording.video_times < shift + end - begin)
    assert model.max() == pytest.approx(recording.height[during].max(), rel=0.1)


def test_alignment_recovers_a_known_shift():
    rng = np.random.default_rng(0)
    times = np.arange(0.0, 4.0, 0.002)

    def swing(t):
        return np.where(t > 0, np.exp(-0.5 * t) * np.abs(np.sin(19.0 * t)) * (1 + np.sin(2.0 * t)), 0.0)

    video = np.arange(0.0, 20.0, 1.0 / 60.0)
    height = swing(video - 7.1234) + 0.02 * rng.standard_normal(len(video))
    shift, correlation = align(video, height, times, swing(times))
    assert shift == pytest.approx(7.1234, abs=0.004)
    assert correlation > 0.97
    with pytest.raises(DataError, match="shorter"):
        align(video[:100], height[:100], times, swing(times))


@pytest.mark.parametrize("short_axis", [0.0, 0.5])
def test_residual_of_an_elliptic_swing(short_axis):
    times = np.arange(0.0, 3.0, 1.0 / 60.0)
    phase = 2.0 * np.pi * 3.02 * times + 0.4
    ellipse = np.hypot(np.cos(phase), short_axis * np.sin(phase))
    found = residual_oscillation(times, 4e-3 * np.exp(-0.3 * times) * ellipse, 2.9)
    assert found.frequency == pytest.approx(3.02, rel=1e-3)
    assert found.decay == pytest.approx(0.3, rel=1e-2)
    assert found.height == pytest.approx(4e-3, rel=1e-2)
    assert found.visible == pytest.approx((1.0 - short_axis**2) / (1.0 + short_axis**2), rel=1e-2)


@have_cylinder
def test_side_of_a_crest_turns_with_the_hand():
    spinning = read_cylinder("LE_2D_0m_5s_900deg")
    crest = np.tile([[0.0, 1.0]], (200, 1))
    times = np.linspace(0.0, 6.0, 200)
    side = spinning.crest_side(times, crest)
    assert side[0] == pytest.approx(np.cos(np.radians(22.0)))
    assert side.min() < -0.99 and side.max() > 0.99
    turned, straight = (read_cylinder(n) for n in ("Tilt_TRD_3D_0.3m_3s_30deg", "Tilt_RD_3D_0.3m_7s_30deg"))
    np.testing.assert_allclose(turned.crest_side(times[:2], crest[:2]), -straight.crest_side(times[:2], crest[:2]))


@have_digitised
def test_digitised_tables():
    tank = faltinsen()
    assert len(tank) > 150 and np.abs(tank[:, 1]).max() < 0.6 and np.all(np.diff(tank[:, 0]) >= 0)
    columns = martin_moyce()
    assert set(columns) == {"a = 1.125 in", "a = 2.25 in", "Koshizuka"}
    for table in columns.values():
        assert np.all(np.diff(table, axis=0) > 0) and table[0, 1] < 1.6


def test_faults_are_named(tmp_path):
    with pytest.raises(DataError, match="no recordings"):
        recording_names(tmp_path)
    with pytest.raises(DataError, match="There is no"):
        faltinsen(tmp_path)
    (tmp_path / "motion").mkdir()
    (tmp_path / "heights").mkdir()
    motion, height = tmp_path / "motion" / "LE_2D.csv", tmp_path / "heights" / "LE_2D.csv"
    height.write_text("t_s,height_mm\n" + "".join(f"{i / 60},0.0\n" for i in range(100)))

    def write(orientation="0;0;0;1", jump=0.0):
        motion.write_text("".join(f"{0.002 * i + jump * (i == 50)};0;0;0;{orientation}\n" for i in range(200)))

    write("0;0;0;x")
    with pytest.raises(DataError, match="not a table"):
        read_cylinder("LE_2D", tmp_path)
    write("0;0;1")
    with pytest.raises(DataError, match="8 columns"):
        read_cylinder("LE_2D", tmp_path)
    write("0;0;0;2")
    with pytest.raises(DataError, match="unit quaternions"):
        read_cylinder("LE_2D", tmp_path)
    write(jump=0.5)
    with pytest.raises(DataError, match="equidistant"):
        read_cylinder("LE_2D", tmp_path)
    write()
    recording = read_cylinder("LE_2D", tmp_path)
    assert recording.kind == "LE 2D"
    with pytest.raises(DataError, match="never moves"):
        recording.span()
