"""The ablation of the sub-step form: rows that must come out as known, and files that hold them."""

import csv

from tests.tignn.cell_bodies import write_cell_beams
from zsdt.evaluation.cell_ablation import ablate
from zsdt.tignn.cell_energy import CellOptions, CellStart, nominal_constants
from zsdt.tignn.cell_engine import CellEngine, save_cell_engine
from zsdt.trajectory import Dataset


def test_known_rows_come_out_as_known(tmp_path):
    folder = write_cell_beams(tmp_path / "data", [("test", (4, 2, 2), "dynamic", 0.6)], 25)
    data = Dataset(folder)
    material = data.read(data.split("test")[0]).body.material
    constants = nominal_constants(material.bulk, material.shear, material.g1, material.tau)
    save_cell_engine(tmp_path / "engine", CellEngine(constants, CellOptions(start=CellStart.shift)))
    rows = ablate(folder, tmp_path / "engine", tmp_path / "table", {"mine": str(tmp_path / "engine")}, "the command")
    found = {r["variant"]: r for r in rows}
    assert found["static picture"]["displacement_percent"] == 100.0
    # The truth was made by this very engine, in single precision on the disk.
    assert found["mine"]["displacement_percent"] < 0.1
    assert found["mine"]["stress_percent"] < 0.1
    assert found["final, half the sub-step"]["displacement_percent"] < 1.0
    assert found["final, no memory"]["displacement_percent"] > 5.0
    assert all(r["diverged"] == 0 for name, r in found.items() if "2 times" not in name and "1.6" not in name)
    with (tmp_path / "table.csv").open() as lines:
        assert [r["variant"] for r in csv.DictReader(lines)] == [r["variant"] for r in rows]
    assert "`the command`" in (tmp_path / "table.md").read_text()
