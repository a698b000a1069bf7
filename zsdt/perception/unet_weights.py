"""A trained U-Net in a folder: half-precision weights (below 2 MB) and a card that says what they are."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import torch

from zsdt.errors import DataError, OptionError
from zsdt.files import atomic_path
from zsdt.perception.unet import UNet, UNetOptions

WEIGHTS, CARD = "unet.pt", "unet.json"
LARGEST = 2_000_000  # bytes of shipped weights


def save_unet(folder: str | Path, network: UNet, options: UNetOptions, card: dict[str, Any]) -> None:
    """Writes `unet.pt` (kernels in half precision, the statistics of the normalisation in single) and `unet.json`."""
    folder = Path(folder)
    kept = {
        name: value.half() if value.ndim > 1 else value
        for name, value in network.state_dict().items()
        if not name.endswith("num_batches_tracked")
    }
    content = io.BytesIO()  # in a file, torch would also keep its temporary name, and no two files would be the same
    torch.save(kept, content)
    if content.tell() > LARGEST:
        raise OptionError(
            f"The weights of a U-Net of widths {options.widths} are larger than 2 MB; choose smaller widths."
        )
    with atomic_path(folder / WEIGHTS) as beside:
        beside.write_bytes(content.getvalue())
    with atomic_path(folder / CARD) as beside:
        beside.write_text(
            json.dumps({"kind": "unet", "widths": options.widths, "outputs": network.outputs, **card}, indent=1)
        )


def unet_card(folder: str | Path) -> dict[str, Any]:
    """The card that `save_unet` wrote. Raises: DataError where the folder holds none."""
    try:
        card = json.loads((Path(folder) / CARD).read_text())
        if card["kind"] != "unet":
            raise ValueError(f"it is of kind {card['kind']}")
        return dict(card)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"No trained segmentation in {folder} ({error}); train one (stage train_vision) or name another folder."
        ) from error


def load_unet(folder: str | Path, outputs: int = 1) -> UNet:
    """The network of `outputs` classes that `save_unet` wrote, ready for inference.

    Raises: DataError where it is missing, broken, or of another number of classes.
    """
    card = unet_card(folder)
    if card.get("outputs", 1) != outputs:  # cards of grids were once written without
        raise DataError(
            f"The segmentation in {folder} has {card.get('outputs', 1)} classes where {outputs} are needed: grids have "
            "one, glasses two; name weights that were trained for this scene."
        )
    try:
        network = UNet(UNetOptions(list(card["widths"])), outputs)
        stored = torch.load(Path(folder) / WEIGHTS, weights_only=True)
        missing, unknown = network.load_state_dict({k: v.float() for k, v in stored.items()}, strict=False)
    except Exception as error:  # torch.load raises whatever a broken file makes its readers stumble over
        raise DataError(f"The weights in {folder} are broken ({error}); train them again.") from error
    if unknown or any(not name.endswith("num_batches_tracked") for name in missing):
        raise DataError(f"The weights in {folder} do not fit the widths {card['widths']} of their card.")
    return network.eval()
