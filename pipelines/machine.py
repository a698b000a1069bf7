"""Options of the machine; a file of its own because everything needs them and they need nothing."""

from __future__ import annotations

from dataclasses import dataclass

from zsdt.errors import OptionError


@dataclass
class Machine:
    """Where and how fast, never what: nothing in here is part of an artifact's key.

    outputs: folder of all that a run writes. workers: processes that make data. threads: of one process. shards: pieces
    in which data are made, each an artifact of its own (stage `synthesize_shard`); 1: in one piece.
    """

    outputs: str = "outputs"
    workers: int = 2
    threads: int = 1
    shards: int = 1

    def __post_init__(self) -> None:
        if self.shards < 1:
            raise OptionError(f"machine.shards={self.shards}: data are made in at least one piece.")
