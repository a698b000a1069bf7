"""Content-addressed artifacts: a folder for each stage and key, built once, never half-written.

`<root>/<stage>/<key>/` holds what the stage wrote and `manifest.json`. While it is built it is
`<root>/<stage>/.<key>.part/`, under the file lock `<root>/<stage>/.<key>.lock`, so that a second process waits and
then reuses. `<root>/<stage>/.<key>.scratch/` survives a kill: a training leaves its checkpoints there and goes on
from them; it goes when the artifact is complete.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from zsdt.errors import DataError

KEY_LENGTH = 16
MANIFEST = "manifest.json"

Build = Callable[[Path, Path], dict[str, Any]]


def artifact_key(stage: str, version: int, config: dict[str, Any], inputs: dict[str, str]) -> str:
    """Key of an artifact: hash of the stage and its version, what it reads of the config, and its inputs' keys."""
    text = json.dumps([stage, version, config, inputs], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_LENGTH]


def digest_of_files(paths: Iterable[Path]) -> str:
    """Hash of names and contents of files, so that an artifact made of somebody else's data knows which data.

    Raises: DataError where a file cannot be read.
    """
    digest = hashlib.sha256()
    for path in sorted(paths):
        digest.update(path.name.encode())
        try:
            with path.open("rb") as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
        except OSError as error:
            raise DataError(f"Could not read {path}: {error.strerror}; correct the path or its permissions.") from error
    return digest.hexdigest()[:KEY_LENGTH]


def plain(value: Any) -> Any:
    """`value` as JSON can hold it: numpy numbers and arrays become Python's, paths become text."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    return value if isinstance(value, str | int | float | bool | None) else str(value)


def write_json(path: Path, value: Any) -> None:
    """Writes JSON beside `path` and moves it into place.

    Raises: DataError where the disk does not take it.
    """
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.write_text(json.dumps(plain(value), indent=2) + "\n")
        os.replace(beside, path)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise disk_error(path, error) from error


def disk_error(path: Path, error: Exception) -> DataError:
    """What a person reads when a disk is full, read-only or gone."""
    reason = os.strerror(getattr(error, "errno", None) or errno.ENOSPC)
    return DataError(
        f"Could not write {path}: {reason}; free some space or choose another folder with "
        "machine.outputs=DIR, then run again (finished artifacts are kept)."
    )


@dataclass(frozen=True)
class Artifact:
    """A finished artifact: its stage, key, folder, whether it was there already, and seconds spent on it now."""

    stage: str
    key: str
    path: Path
    reused: bool = True
    seconds: float = 0.0

    @property
    def manifest(self) -> dict[str, Any]:
        """What `manifest.json` says: config, input keys, versions, seed, wall time, host, commit, figures."""
        return json.loads((self.path / MANIFEST).read_text())


class Store:
    """The artifacts below one folder."""

    def __init__(self, root: Path):
        self.root = root

    def folder(self, stage: str, key: str) -> Path:
        """Where an artifact lives (or will)."""
        return self.root / stage / key

    def find(self, stage: str, key: str) -> Artifact | None:
        """The finished artifact, or None."""
        path = self.folder(stage, key)
        return Artifact(stage, key, path) if (path / MANIFEST).is_file() else None

    def obtain(
        self,
        stage: str,
        key: str,
        build: Build,
        manifest: Callable[[], dict[str, Any]],
        on_wait: Callable[[], None] = lambda: None,
    ) -> Artifact:
        """The artifact, built by `build(out, scratch) -> figures` if it is not there.

        Another process that wants the same one waits for this one's lock (`on_wait` is called once) and reuses.

        Raises: DataError where the disk does not take it, and whatever `build` raises; then nothing is left but
        the scratch folder.
        """
        began = time.perf_counter()
        if found := self.find(stage, key):
            return found
        shelf = self.root / stage
        try:
            shelf.mkdir(parents=True, exist_ok=True)
            lock = FileLock(shelf / f".{key}.lock")
            try:
                lock.acquire(timeout=0)
            except Timeout:
                on_wait()
                lock.acquire()
        except OSError as error:
            raise disk_error(shelf, error) from error
        try:
            if found := self.find(stage, key):
                return Artifact(stage, key, found.path, True, time.perf_counter() - began)
            self._build(stage, key, build, manifest)
        finally:
            lock.release()
        return Artifact(stage, key, self.folder(stage, key), False, time.perf_counter() - began)

    def _build(self, stage: str, key: str, build: Build, manifest: Callable[[], dict[str, Any]]) -> None:
        target = self.folder(stage, key)
        beside = target.with_name(f".{key}.part")
        scratch = target.with_name(f".{key}.scratch")
        _remove(beside)  # left by a process that was killed; nobody else builds it, we hold the lock
        began = time.perf_counter()
        try:
            beside.mkdir(parents=True)
            scratch.mkdir(exist_ok=True)
            figures = build(beside, scratch)
            facts = {**manifest(), "wall_seconds": time.perf_counter() - began, "figures": figures}
            write_json(beside / MANIFEST, facts)
            _remove(target)  # a folder without a manifest is not an artifact
            os.replace(beside, target)
        except Exception as error:
            if not isinstance(error, DataError) and _disk_refuses(error, target.parent):
                raise disk_error(target, error) from error
            raise
        finally:
            _remove(beside)
        _remove(scratch)


def _disk_refuses(error: BaseException | None, folder: Path) -> bool:
    """Whether `error` comes from a full or read-only disk; h5py and torch do not always say so themselves."""
    while error is not None:
        refused = isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
        if refused or "No space left on device" in str(error):
            return True
        if isinstance(error, OSError | RuntimeError) and shutil.disk_usage(folder).free < 1 << 20:
            return True
        error = error.__cause__ or error.__context__
    return False


def _remove(folder: Path) -> None:
    if folder.exists():
        shutil.rmtree(folder)
