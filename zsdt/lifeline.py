"""Workers end with whoever started them: a sweep that is killed leaves nobody behind who goes on computing."""

from __future__ import annotations

import os
import threading
import time

import psutil

PARENT = "ZSDT_PARENT"
_watched: set[int] = set()


def adopt_children() -> None:
    """Lets processes that are started from here on know whom to follow."""
    os.environ[PARENT] = str(os.getpid())


def follow_parent(every: float = 1.0) -> None:
    """Ends this process soon after the one that adopted it has ended; does nothing where nobody did."""
    parent = os.getppid()
    if os.environ.get(PARENT) == str(parent):
        follow(parent, every)


def follow(leader: int, every: float = 1.0) -> None:
    """Ends this process within about `every` [s] after process `leader` of this machine has ended, parent or not."""
    if leader in _watched:
        return
    _watched.add(leader)
    try:
        process = psutil.Process(leader)
    except psutil.NoSuchProcess:
        os._exit(1)

    def watch() -> None:
        while _alive(process):
            time.sleep(every)
        os._exit(1)  # locks go with the process, scratch folders stay

    threading.Thread(target=watch, daemon=True, name=f"follow-{leader}").start()


def _alive(process: psutil.Process) -> bool:
    """Whether it runs; one that was killed and that nobody has asked about yet (a zombie) does not."""
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
