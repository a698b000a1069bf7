"""What VTK's own reader finds in exported files: every point, field and time, in its order of corners and tensors."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.tignn.conftest import make_body, make_trajectory
from tests.tignn.liquid_bodies import make_flow, make_liquid
from zsdt.errors import DataError
from zsdt.evaluation.baselines import StaticBaseline
from zsdt.fields import von_mises
from zsdt.fluid.vessel import Vessel
from zsdt.interop.vtk_export import vessel_surface, write_rollout_vtk, write_trajectory_vtk
from zsdt.interop.vtkhdf import MovingMesh, write_moving_mesh
from zsdt.tignn.engine import roll_out
from zsdt.trajectory import Trajectory


class Reader:
    """VTK's reader of one file."""

    def __init__(self, path: Path):
        hdf = pytest.importorskip("vtkmodules.vtkIOHDF", reason="the optional package vtk is not installed")
        from vtkmodules.util.numpy_support import vtk_to_numpy

        self.numpy = vtk_to_numpy
        self.reader = hdf.vtkHDFReader()
        assert self.reader.CanReadFile(str(path))
        self.reader.SetFileName(str(path))
        self.reader.UpdateInformation()

    @property
    def times(self) -> list[float]:
        pipeline = self.reader.GetOutputInformation(0)
        key = self.reader.GetExecutive().TIME_STEPS()
        return [pipeline.Get(key, k) for k in range(pipeline.Length(key))]

    def at(self, frame: int):
        """The data set of a frame, as an application asks for it: by its time."""
        if len(self.times) > frame:
            self.reader.UpdateTimeStep(self.times[frame])
        self.reader.Update()
        return self.reader.GetOutputDataObject(0)

    def points(self, frame: int) -> np.ndarray:
        return self.numpy(self.at(frame).GetPoints().GetData())

    def field(self, frame: int, name: str, of: str = "Point") -> np.ndarray:
        data = getattr(self.at(frame), f"Get{of}Data")()
        return self.numpy(data.GetArray(name))


def same(found: np.ndarray, wanted: np.ndarray) -> bool:
    """Bitwise the single-precision number."""
    return np.array_equal(found, wanted.astype(np.float32).reshape(found.shape))


@pytest.fixture(scope="module")
def beam() -> Trajectory:
    return make_trajectory(make_body((4, 2, 3)), frames=6)


def test_vtk_reads_a_beam_back_to_the_last_bit_at_every_time(tmp_path: Path, beam: Trajectory) -> None:
    beam = replace(beam, ledger={"kinetic": np.linspace(1.0, 2.0, beam.frames)})
    (path,) = write_trajectory_vtk(tmp_path / "beam.vtkhdf", beam)
    reader = Reader(path)
    assert np.array_equal(reader.times, beam.times)
    for frame in (3, 0, 5, 1, 2, 4):  # in any order, as somebody who drags the slider
        assert same(reader.points(frame), beam.fields["position"][frame])
        for name in ("velocity", "elastic_energy", "dissipated_energy"):
            assert same(reader.field(frame, name), beam.fields[name][frame]), name
        assert same(reader.field(frame, "load"), beam.load[frame])
        assert same(reader.field(frame, "von_mises"), von_mises(beam.fields["stress"][frame]))
        assert same(reader.field(frame, "displacement"), (beam.fields["position"][frame] - beam.fields["position"][0]))
        assert same(reader.field(frame, "clamped"), beam.body.clamped.astype(float))
        assert reader.field(frame, "kinetic_J", "Field") == [beam.ledger["kinetic"][frame]]


def test_stress_is_in_the_order_in_which_vtk_makes_a_tensor_of_six_numbers(tmp_path: Path, beam: Trajectory) -> None:
    (path,) = write_trajectory_vtk(tmp_path / "beam.vtkhdf", beam)
    s11, s22, s33, s12, s13, s23 = beam.fields["stress"][2, 7]
    xx, yy, zz, xy, yz, xz = Reader(path).field(2, "stress")[7]
    assert np.allclose([xx, yy, zz, xy, yz, xz], [s11, s22, s33, s12, s23, s13], rtol=1e-6)


def test_hexahedra_are_not_twisted(tmp_path: Path, beam: Trajectory) -> None:
    """VTK's own volumes of the bricks are those of the bricks: a wrong order of corners gives zero or less."""
    core = pytest.importorskip("vtkmodules.vtkFiltersVerdict", reason="the optional package vtk is not installed")
    at_rest = np.broadcast_to(beam.body.points, beam.fields["position"].shape)
    (path,) = write_trajectory_vtk(tmp_path / "rest.vtkhdf", replace(beam, fields={**beam.fields, "position": at_rest}))
    reader = Reader(path)
    sizes = core.vtkCellSizeFilter()
    sizes.SetInputData(reader.at(0))
    sizes.Update()
    volumes = reader.numpy(sizes.GetOutput().GetCellData().GetArray("Volume"))
    assert np.allclose(volumes, beam.body.pitch**3, rtol=1e-5)


def test_cell_data_of_a_uniform_stretch_is_the_closed_form(tmp_path: Path, beam: Trajectory) -> None:
    stretch = np.array([1.2, 0.9, 1.1])
    tension = np.zeros_like(beam.fields["stress"])
    tension[..., 0] = 700.0
    energy = np.full((beam.frames, beam.body.nodes, 1), 3.0)
    fields = {
        "position": np.broadcast_to(beam.body.points * stretch, beam.fields["position"].shape),
        "stress": tension,
        "elastic_energy": energy,
    }
    (path,) = write_trajectory_vtk(tmp_path / "stretched.vtkhdf", replace(beam, fields=fields))
    reader = Reader(path)
    assert np.allclose(reader.field(4, "volume_ratio", "Cell"), stretch.prod(), rtol=1e-6)
    assert np.allclose(reader.field(4, "von_mises", "Cell"), 700.0, rtol=1e-6)
    assert np.allclose(reader.field(4, "elastic_energy", "Cell"), 3.0, rtol=1e-6)


def test_a_rollout_has_its_errors_and_ends_where_it_diverged(tmp_path: Path, beam: Trajectory) -> None:
    rollout = roll_out(StaticBaseline(), beam)
    (path,) = write_rollout_vtk(tmp_path / "static.vtkhdf", beam, rollout)
    moved = beam.fields["position"][4] - beam.fields["position"][0]
    # Nothing moves in it, so its error is the true displacement the other way round.
    assert np.allclose(Reader(path).field(4, "position_error"), -moved, atol=1e-7)
    broken = replace(rollout, fields={name: values.copy() for name, values in rollout.fields.items()}, diverged_at=3)
    for values in broken.fields.values():
        values[3:] = np.nan
    (path,) = write_rollout_vtk(tmp_path / "broken.vtkhdf", beam, broken)
    reader = Reader(path)
    assert np.array_equal(reader.times, beam.times[:3]) and np.isfinite(reader.points(2)).all()
    with pytest.raises(DataError, match="predicted no frame"):
        write_rollout_vtk(tmp_path / "nothing.vtkhdf", beam, replace(broken, diverged_at=1))


def test_a_liquid_is_particles_and_its_vessel_a_surface_on_the_wall(tmp_path: Path) -> None:
    body = make_liquid()
    flow = make_flow(body, frames=4)
    liquid, vessel = write_trajectory_vtk(tmp_path / "glass.vtkhdf", flow)
    reader = Reader(liquid)
    for frame in range(4):
        assert same(reader.points(frame), flow.fields["position"][frame])
        assert same(reader.field(frame, "internal_energy"), flow.fields["internal_energy"][frame])
        assert same(reader.field(frame, "speed"), np.linalg.norm(flow.fields["velocity"][frame], axis=1))
    assert reader.at(0).GetNumberOfCells() == body.nodes and reader.at(0).GetCellType(0) == 1
    wall = Reader(vessel)
    points = wall.points(0).astype(float)
    assert body.vessel is not None
    assert np.abs(Vessel(body.vessel).distance(points)).max() < 1e-5
    made, polygons = vessel_surface(Vessel(body.vessel))
    assert same(points.astype(np.float32), made) and wall.at(0).GetNumberOfCells() == sum(map(len, polygons))
    sides, floor = (np.cross(made[p[:, 1]] - made[p[:, 0]], made[p[:, 2]] - made[p[:, 0]]) for p in polygons)
    away = made[polygons[0][:, 0]] * [1.0, 1.0, 0.0]
    assert floor[0, 2] > 0 and ((sides * away).sum(1) < 0).all(), "the inner side is seen, from where the liquid is"


def test_an_unknown_load_is_left_out(tmp_path: Path, beam: Trajectory) -> None:
    (path,) = write_trajectory_vtk(tmp_path / "twin.vtkhdf", replace(beam, load=np.full(beam.load.shape, np.nan)))
    with h5py.File(path) as file:
        assert "load" not in file["VTKHDF/PointData"] and "velocity" in file["VTKHDF/PointData"]


def test_shapes_that_do_not_fit_are_refused_before_a_file_is_there(tmp_path: Path) -> None:
    mesh = MovingMesh(np.arange(3.0), np.zeros((3, 5, 3)), np.arange(5)[:, None], 1)
    with pytest.raises(DataError, match="velocity has the shape"):
        write_moving_mesh(tmp_path / "x.vtkhdf", replace(mesh, point_data={"velocity": np.zeros((3, 4, 3))}))
    with pytest.raises(DataError, match="names a node"):
        write_moving_mesh(tmp_path / "x.vtkhdf", replace(mesh, cells=np.array([[5]])))
    assert not list(tmp_path.iterdir())
