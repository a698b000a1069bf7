"""A stand-in for torch_geometric, so that tests can write the files that it would write."""

import sys
import types

import pytest

PACKAGE = ("torch_geometric", "torch_geometric.data", "torch_geometric.data.data", "torch_geometric.data.storage")


@pytest.fixture
def geometric(monkeypatch):
    """A torch_geometric that exists just long enough to write files which carry its names."""
    modules = {name: types.ModuleType(name) for name in PACKAGE}
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)

    class GlobalStorage:
        def __init__(self, mapping, parent):
            self._mapping, self._parent = mapping, parent

    class Data:
        def __init__(self, **values):
            self.__dict__["_store"] = GlobalStorage(values, self)

    class OldData:
        def __init__(self, **values):
            self.__dict__.update({"edge_attr": None, "pos": None, **values})

    for made, module, name in (
        (Data, PACKAGE[2], "Data"),
        (OldData, PACKAGE[2], "OldData"),
        (GlobalStorage, PACKAGE[3], "GlobalStorage"),
    ):
        made.__module__, made.__qualname__, made.__name__ = module, name, name
        setattr(modules[module], name, made)
    return types.SimpleNamespace(Data=Data, OldData=OldData, modules=PACKAGE)
