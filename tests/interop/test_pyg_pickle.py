"""Files of graphs are read without torch_geometric, and a hostile one is refused before it runs anything."""

import os
import pickle
import sys
import zipfile
from collections import OrderedDict

import numpy as np
import pytest
import torch

from zsdt.errors import DataError
from zsdt.interop.pyg_pickle import Record, attributes, read_torch_file


def values():
    random = torch.Generator().manual_seed(0)
    base = torch.randn(6, 10, generator=random)
    return {
        "x": base[:, 2:5],  # a view: offset and strides that are not those of its own memory
        "f": base.t(),
        "n": torch.eye(2)[[0, 1, 0]],
        "edge_index": torch.tensor([[0, 1], [1, 0]]),
        "mask": torch.tensor([True, False]),
        "empty": torch.zeros(0, 3),
        "double": torch.arange(4, dtype=torch.float64).reshape(2, 2),
    }


@pytest.mark.parametrize("container", ["zip", "legacy"])
@pytest.mark.parametrize("kind", ["Data", "OldData"])
def test_what_torch_wrote_comes_back_as_arrays(geometric, tmp_path, container, kind):
    path = tmp_path / "graphs.pt"
    wanted = values()
    graphs = [getattr(geometric, kind)(**wanted), getattr(geometric, kind)(x=wanted["x"] + 1)]
    torch.save(graphs, path, _use_new_zipfile_serialization=container == "zip")
    for name in geometric.modules:
        sys.modules.pop(name, None)
    found = read_torch_file(path)
    assert all(isinstance(graph, Record) for graph in found)
    first = attributes(found[0])
    assert set(first) == set(wanted)
    for name, tensor in wanted.items():
        assert first[name].dtype == tensor.numpy().dtype
        np.testing.assert_array_equal(first[name], tensor.numpy())
    np.testing.assert_array_equal(attributes(found[1])["x"], wanted["x"].numpy() + 1)
    assert not set(geometric.modules) & set(sys.modules)


def test_plain_containers_come_back(tmp_path):
    content = OrderedDict(a=[1, 2.5, "x", None, True], b={"t": (torch.ones(2), torch.zeros(1))})
    torch.save(content, tmp_path / "plain.pt")
    found = read_torch_file(tmp_path / "plain.pt")
    assert list(found) == ["a", "b"] and found["a"] == content["a"]
    np.testing.assert_array_equal(found["b"]["t"][0], [1.0, 1.0])


class Hostile:
    """Unpickled carelessly, it makes a folder."""

    def __init__(self, call, *arguments):
        self.call, self.arguments = call, arguments

    def __reduce__(self):
        return self.call, self.arguments


@pytest.mark.parametrize("container", ["zip", "legacy", "bare"])
@pytest.mark.parametrize("nested", [False, True])
def test_hostile_pickle_is_refused_by_name_and_does_not_run(tmp_path, container, nested):
    victim = tmp_path / "made_by_pickle"
    evil = Hostile(os.mkdir, str(victim))
    content = [{"x": torch.ones(1), "y": evil}] if nested else evil
    path = tmp_path / "evil.pt"
    if container == "bare":
        path.write_bytes(pickle.dumps([Hostile(os.mkdir, str(victim))]))
    else:
        torch.save(content, path, _use_new_zipfile_serialization=container == "zip")
    with pytest.raises(DataError, match=r"posix\.mkdir|os\.mkdir"):
        read_torch_file(path)
    assert not victim.exists()


@pytest.mark.parametrize(
    "call",
    [eval, getattr, __import__, torch.load, torch.hub.load, np.frombuffer, type],
    ids=lambda call: call.__name__,
)
def test_no_other_callable_is_let_in(tmp_path, call):
    torch.save(Hostile(call, "1"), tmp_path / "call.pt")
    with pytest.raises(DataError, match="refused without running"):
        read_torch_file(tmp_path / "call.pt")


def test_a_stand_in_offers_no_way_to_a_callable(tmp_path):
    """A dotted name below torch_geometric resolves to the inert record too, whatever it says."""
    body = b"\x80\x02ctorch_geometric.os\nsystem\nX\x08\x00\x00\x00touch /x\x85R."
    with zipfile.ZipFile(tmp_path / "call.pt", "w") as archive:
        archive.writestr("archive/data.pkl", body)
    assert isinstance(read_torch_file(tmp_path / "call.pt"), Record)


def forged(tmp_path, body, storage=b"\0" * 8):
    path = tmp_path / "forged.pt"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", body)
        archive.writestr("archive/data/0", storage)
    return path


def tensor_pickle(offset, shape, stride, count=2):
    """Opcodes of one float tensor over a storage of `count` numbers."""

    class Tensor:
        def __reduce__(self):
            return torch._utils._rebuild_tensor_v2, (Storage(), offset, shape, stride, False, OrderedDict())

    class Storage:
        pass

    import io

    class Pickler(pickle.Pickler):
        def persistent_id(self, thing):
            return ("storage", torch.FloatStorage, "0", "cpu", count) if isinstance(thing, Storage) else None

    buffer = io.BytesIO()
    Pickler(buffer, protocol=2).dump(Tensor())
    return buffer.getvalue()


def test_forged_tensor_cannot_reach_outside_its_memory(tmp_path):
    np.testing.assert_array_equal(read_torch_file(forged(tmp_path, tensor_pickle(0, (2,), (1,)))), [0.0, 0.0])
    for offset, shape, stride in [
        (0, (3,), (1,)),
        (2, (1,), (1,)),
        (0, (2,), (9,)),
        (0, (2,), (-1,)),
        (-1, (1,), (1,)),
    ]:
        with pytest.raises(DataError, match="broken"):
            read_torch_file(forged(tmp_path, tensor_pickle(offset, shape, stride)))
    with pytest.raises(DataError, match="needs 12 bytes, found 8"):
        read_torch_file(forged(tmp_path, tensor_pickle(0, (2,), (1,), count=3)))


def test_missing_truncated_and_foreign_files_give_one_sentence(tmp_path):
    with pytest.raises(DataError, match="There is no file"):
        read_torch_file(tmp_path / "absent.pt")
    torch.save(torch.ones(1000), tmp_path / "whole.pt")
    (tmp_path / "half.pt").write_bytes((tmp_path / "whole.pt").read_bytes()[:700])
    (tmp_path / "text.pt").write_text("no pickle at all")
    for name in ("half.pt", "text.pt"):
        with pytest.raises(DataError, match="fetch it again") as caught:
            read_torch_file(tmp_path / name)
        assert "\n" not in str(caught.value)
