"""Workers end with whoever started them: a sweep that is killed leaves nobody behind who goes on computing."""

from __future__ import annotations

import os
import threading
import time

PARENT = "ZSDT_PARENT"
_watched: set[int] = set()


def adopt_children() -> None:
    """Lets processes that are started from here on know whom to follow."""
    os.environ[PARENT] = str(os.getpid())


def follow_parent(every: float = 1.0) -> None:
    """Ends this process soon after the one that adopted it has ended; does nothing where nobody did."""
    parent = os.getppid()
    if os.environ.get(PARENT) != str(parent) or parent in _watched:
        return
    _watched.add(parent)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(every)
        os._exit(1)  # locks go with the process, scratch folders stay

    threading.Thread(target=watch, daemon=True, name="follow-parent").start()
