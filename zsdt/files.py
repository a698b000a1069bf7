"""Where data live, and writing files so that nobody ever sees half of one."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from zsdt.errors import DataError


def data_root() -> Path:
    """Folder with the third-party data: `$ZSDT_DATA`, or `../shared/data` beside the repository."""
    named = os.environ.get("ZSDT_DATA")
    return Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "data"


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Gives a path beside `path` to write to; moves it into place on success and removes it on failure.

    Works for files and for folders that do not exist yet. An `OSError` (such as a full disk) becomes a
    `DataError` that names the file.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    beside = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.part")
    try:
        yield beside
        os.replace(beside, target)
    except OSError as error:
        raise DataError(
            f"Could not write {target}: {os.strerror(error.errno) if error.errno else error}. "
            "Free some space or choose another output folder, then run again."
        ) from error
    finally:
        if beside.is_dir():
            shutil.rmtree(beside, ignore_errors=True)
        else:
            beside.unlink(missing_ok=True)
