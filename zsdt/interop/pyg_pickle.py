"""Reads PyTorch files that hold PyTorch-Geometric graphs, without torch_geometric and without running their code.

A `.pt` file is a pickle, and a pickle may call anything. This reader calls nothing that the file names: tensors
become numpy arrays, classes of torch_geometric become `Record` (a bag of attributes), and any other global is
refused with its name. Both containers are read: the zip of torch >= 1.6 and the stream of pickles before it.
"""

from __future__ import annotations

import io
import os
import pickle
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np

from zsdt.errors import DataError

_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_PROTOCOL = 1001
_DTYPES = {
    "DoubleStorage": "<f8",
    "FloatStorage": "<f4",
    "HalfStorage": "<f2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "|i1",
    "ByteStorage": "|u1",
    "BoolStorage": "|b1",
}


class Record:
    """Inert stand-in for an object of torch_geometric: keeps what the pickle gives it and does nothing."""

    def __init__(self, *args: Any, **kwargs: Any):
        self.arguments = args

    def __setstate__(self, state: Any) -> None:
        if isinstance(state, tuple) and len(state) == 2:  # (dict, slots)
            state = {**(state[0] or {}), **(state[1] or {})}
        if not isinstance(state, dict):
            raise pickle.UnpicklingError("an object of torch_geometric has a state that is not a dictionary")
        self.__dict__.update({str(key): value for key, value in state.items()})


def attributes(record: Record) -> dict[str, Any]:
    """Attributes of a stored graph: of its `_store` (torch_geometric >= 2) or of itself (before), by name."""
    store = vars(record).get("_store")
    if isinstance(store, Record):
        mapping = vars(store).get("_mapping", {})
        return dict(mapping)
    hidden = ("arguments",)
    return {k: v for k, v in vars(record).items() if k not in hidden and not k.startswith("__") and v is not None}


class _Storage:
    """Flat memory of tensors; in the legacy container it is filled after the objects have been read."""

    def __init__(self, dtype: str, count: int):
        self.flat = np.zeros(0, dtype)
        self.dtype, self.count = np.dtype(dtype), count

    def fill(self, raw: bytes) -> None:
        if len(raw) != self.count * self.dtype.itemsize:
            raise pickle.UnpicklingError(f"a tensor needs {self.count * self.dtype.itemsize} bytes, found {len(raw)}")
        self.flat = np.frombuffer(raw, self.dtype)


class _Tensor:
    """A view of a storage, cut out when all storages are there."""

    def __init__(self, storage: _Storage, offset: int, shape: tuple[int, ...], stride: tuple[int, ...]):
        self.storage, self.offset, self.shape, self.stride = storage, offset, tuple(shape), tuple(stride)

    def __setstate__(self, state: Any) -> None:
        """Tensors carry no state of their own in these files; ignore what a subclass may have added."""

    def array(self) -> np.ndarray:
        flat, shape, stride = self.storage.flat, self.shape, self.stride
        if len(shape) != len(stride) or min((*shape, *stride, self.offset), default=0) < 0:
            raise pickle.UnpicklingError("a tensor has an impossible shape")
        if 0 in shape:
            return np.zeros(shape, flat.dtype)
        last = self.offset + sum((n - 1) * s for n, s in zip(shape, stride, strict=True))
        if last >= len(flat):
            raise pickle.UnpicklingError("a tensor reaches past the end of its storage")
        steps = [s * flat.itemsize for s in stride]
        return np.lib.stride_tricks.as_strided(flat[self.offset :], shape, steps, writeable=False).copy()


def _rebuild_tensor(storage: Any, offset: int, shape: Any, stride: Any, *rest: Any) -> _Tensor:
    """Stands for torch._utils._rebuild_tensor and _rebuild_tensor_v2."""
    if not isinstance(storage, _Storage):
        raise pickle.UnpicklingError("a tensor without a storage")
    return _Tensor(storage, int(offset), tuple(map(int, shape)), tuple(map(int, stride)))


class _Refused(pickle.UnpicklingError):
    """A pickle named something that is not on the list."""


class _RestrictedUnpickler(pickle.Unpickler):
    """Unpickler that resolves only tensors, ordered dictionaries and stand-ins for torch_geometric."""

    def __init__(self, file: io.BufferedIOBase):
        super().__init__(file, encoding="utf-8")
        self.storages: dict[str, _Storage] = {}

    def find_class(self, module: str, name: str) -> Any:
        if module == "torch._utils" and name in ("_rebuild_tensor", "_rebuild_tensor_v2"):
            return _rebuild_tensor
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if module == "torch" and name in _DTYPES:
            return _DTYPES[name]
        if module == "torch_geometric" or module.startswith("torch_geometric."):
            return Record
        raise _Refused(f"{module}.{name}")

    def persistent_load(self, pid: Any) -> _Storage:
        if not (isinstance(pid, tuple) and len(pid) >= 5 and pid[0] == "storage"):
            raise pickle.UnpicklingError("an unknown kind of external object")
        _, dtype, key, _, count = pid[:5]
        if dtype not in _DTYPES.values() or int(count) < 0:
            raise pickle.UnpicklingError("a storage of an unknown type")
        if len(pid) > 5 and pid[5] is not None:
            raise pickle.UnpicklingError("a storage that is a view of another one, which this reader does not know")
        return self.storages.setdefault(str(key), _Storage(dtype, int(count)))


def _with_arrays(value: Any, seen: dict[int, Any]) -> Any:
    """The same object with each tensor replaced by its array; records and containers are changed in place."""
    if isinstance(value, _Tensor):
        return value.array()
    if isinstance(value, tuple):
        return tuple(_with_arrays(v, seen) for v in value)
    if id(value) in seen:
        return value
    seen[id(value)] = value
    if isinstance(value, Record):
        for key, inner in list(vars(value).items()):
            vars(value)[key] = _with_arrays(inner, seen)
    elif isinstance(value, dict):
        for key, inner in list(value.items()):
            value[key] = _with_arrays(inner, seen)
    elif isinstance(value, list):
        value[:] = [_with_arrays(v, seen) for v in value]
    return value


def _read_zip(path: Path) -> Any:
    with zipfile.ZipFile(path) as archive:
        pickles = [n for n in archive.namelist() if n == "data.pkl" or n.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise pickle.UnpicklingError("the archive holds no data.pkl")
        root = pickles[0][: -len("data.pkl")]
        if f"{root}byteorder" in archive.namelist() and archive.read(f"{root}byteorder") != b"little":
            raise pickle.UnpicklingError("the tensors are not little-endian")
        reader = _RestrictedUnpickler(io.BytesIO(archive.read(pickles[0])))
        content = reader.load()
        for key, storage in reader.storages.items():
            storage.fill(archive.read(f"{root}data/{key}"))
    return _with_arrays(content, {})


def _read_legacy(path: Path) -> Any:
    with path.open("rb") as file:
        header = [_RestrictedUnpickler(file).load() for _ in range(3)]
        if header[0] != _LEGACY_MAGIC or header[1] != _LEGACY_PROTOCOL:
            raise pickle.UnpicklingError("it is not a file of torch.save")
        reader = _RestrictedUnpickler(file)
        content = reader.load()
        for key in _RestrictedUnpickler(file).load():
            storage = reader.storages[str(key)]
            count = int.from_bytes(file.read(8), "little", signed=True)
            if count != storage.count:
                raise pickle.UnpicklingError("a storage has another length than its tensors say")
            storage.fill(file.read(count * storage.dtype.itemsize))
    return _with_arrays(content, {})


def read_torch_file(path: str | os.PathLike[str]) -> Any:
    """What `torch.save` put into a file: containers, numbers, numpy arrays for tensors, `Record` for graphs.

    Nothing that the file names is imported or called.

    Raises: DataError where the file is missing or broken, or names a global that is not on the list.
    """
    target = Path(path)
    if not target.is_file():
        raise DataError(f"There is no file {path}; correct the path.")
    try:
        return _read_zip(target) if zipfile.is_zipfile(target) else _read_legacy(target)
    except _Refused as refused:
        raise DataError(
            f"{path} asks for '{refused}', which a file of graphs has no need of; it was refused without running it. "
            "Use only the published files."
        ) from refused
    except Exception as error:  # a broken pickle can raise nearly anything
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise DataError(f"{path} is broken or no file of torch.save ({reason}); fetch it again.") from error
