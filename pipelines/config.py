"""The structured config: options of the rooms under one root, so that a mistyped key fails before anything runs."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Machine:
    """Where and how fast, never what: nothing in here is part of an artifact's key.

    outputs: folder of all that a run writes. workers: processes that make data. threads: of one process.
    device: where networks train and run (cpu, cuda).
    """

    outputs: str = "outputs"
    workers: int = 2
    threads: int = 1
    device: str = "cpu"
