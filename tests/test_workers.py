"""Processes that make data end with the one that started them, and one that is killed is named."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import psutil
import pytest
from tqdm import tqdm

from zsdt.errors import DataError
from zsdt.workers import run_all

SCRIPT = """
import sys
sys.path[:0] = [{tests!r}, {root!r}]
from test_workers import make_two
if __name__ == "__main__":
    make_two({folder!r})
"""


def sleep_long(path: str) -> dict[str, Any]:
    """Says which process it is, and never ends."""
    Path(path + ".part").write_text(str(os.getpid()))
    os.replace(path + ".part", path)
    time.sleep(600)
    return {}


def make_two(folder: str) -> None:
    """Two processes that make something."""
    with tqdm(disable=True) as bar:
        run_all(sleep_long, {name: (f"{folder}/{name}.pid",) for name in "ab"}, 2, {}, bar)


def processes(folder: Path) -> list[psutil.Process]:
    """The two, once both are at work."""
    deadline = time.monotonic() + 60
    while len(found := list(folder.glob("*.pid"))) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    return [psutil.Process(int(path.read_text())) for path in found]


def test_they_end_with_who_started_them(tmp_path: Path) -> None:
    script = tmp_path / "leader.py"
    here = Path(__file__).parent
    script.write_text(SCRIPT.format(tests=str(here), root=str(here.parent), folder=str(tmp_path)))
    leader = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    workers = processes(tmp_path)
    leader.kill()
    leader.wait()
    assert len(workers) == 2 and psutil.wait_procs(workers, timeout=20)[1] == []


def test_one_that_is_killed_is_named(tmp_path: Path) -> None:
    killer = threading.Thread(target=lambda: processes(tmp_path)[0].send_signal(signal.SIGKILL), daemon=True)
    killer.start()
    with pytest.raises(DataError, match=r"killed .* fewer machine\.workers"):
        make_two(str(tmp_path))
