"""How the networks of Psi_ini are trained and kept, solids and liquids alike."""

from __future__ import annotations

import csv
import json
import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import nn

from zsdt.errors import DataError
from zsdt.files import atomic_path

log = logging.getLogger(__name__)


def optimise(
    network: nn.Module,
    loss_of: Callable[[int], torch.Tensor],
    judge: Callable[[], float],
    *,
    steps: int,
    learning_rate: float,
    check_every: int,
    scratch: Path,
) -> list[dict[str, Any]]:
    """Adam with a cosine rate on `loss_of(step)`, a mean squared relative error; leaves the weights that were best.

    `judge` is asked every `check_every` steps and smaller is better. The state is kept in `scratch`, so that a killed
    run goes on to the same weights. Returns a row (step, train, val) per question.
    """
    optimizer = torch.optim.Adam(network.parameters(), lr=learning_rate)
    mark = scratch / "psi_ini_training.pt"
    state: dict[str, Any] = {"step": 0, "best": float("inf"), "weights": network.state_dict(), "rows": []}
    if mark.is_file():
        state = torch.load(mark, weights_only=True)
        network.load_state_dict(state["network"])
        optimizer.load_state_dict(state["optimizer"])
        log.info("psi_ini goes on from step %d", state["step"])
    total = 0.0
    for step in range(state["step"], steps):
        for group in optimizer.param_groups:
            group["lr"] = learning_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / steps)))
        loss = loss_of(step)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        total += float(loss.detach())
        if (step + 1) % check_every == 0 or step + 1 == steps:
            network.eval()
            value = judge()
            network.train()
            state["rows"].append({"step": step + 1, "train": (total / check_every) ** 0.5, "val": value})
            log.info("psi_ini %d: train %.4f, val %.4f", step + 1, (total / check_every) ** 0.5, value)
            total = 0.0
            if value <= state["best"]:
                state.update(best=value, weights={k: v.clone() for k, v in network.state_dict().items()})
            state.update(step=step + 1, network=network.state_dict(), optimizer=optimizer.state_dict())
            with atomic_path(mark) as beside:
                torch.save(state, beside)
    network.load_state_dict(state["weights"])
    return state["rows"]


def keep(out: Path, network: nn.Module, card: dict[str, Any], rows: list[dict[str, Any]]) -> None:
    """Writes `weights.pt`, `psi_ini.json` (the card) and `training.csv` into `out`."""
    with atomic_path(out / "weights.pt") as beside:
        torch.save(network.state_dict(), beside)
    with atomic_path(out / "psi_ini.json") as beside:
        beside.write_text(json.dumps(card, indent=1))
    with atomic_path(out / "training.csv") as beside, beside.open("w", newline="") as lines:
        writer = csv.DictWriter(lines, ["step", "train", "val"])
        writer.writeheader()
        writer.writerows(rows)


def card_of(folder: str | Path) -> dict[str, Any]:
    """The card that `keep` wrote; its `kind` says whose Psi_ini it is, "solid" where it says nothing.

    Raises: DataError where the folder holds none.
    """
    try:
        card = json.loads((Path(folder) / "psi_ini.json").read_text())
        return {"kind": "solid", **card}
    except (OSError, ValueError, TypeError) as error:
        raise DataError(f"The Psi_ini in {folder} is broken or missing ({error}); train it again.") from error
