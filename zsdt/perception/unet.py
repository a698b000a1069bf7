"""A small U-Net that says for every pixel what is there: paint of the grid, or container and liquid.

Ronneberger et al. 2015, made for a CPU: 2 x 2 pixels are folded into channels before the first convolution and
unfolded at the end (Shi et al. 2016), so that only two narrow convolutions run at full resolution. They look at the
picture once more, to put the edges of thin lines where they are.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import nn
from torch.nn import functional

from zsdt.errors import OptionError

FOLD = 2  # pixels along each side that become channels
FINE = 4, 8  # channels at full resolution: what comes from below, and what is made of it


@dataclass
class UNetOptions:
    """widths: channels from the finest level to the coarsest; every level halves the picture."""

    widths: list[int] = field(default_factory=lambda: [16, 32, 48, 64, 96])

    def __post_init__(self) -> None:
        if len(self.widths) < 2 or min(self.widths) < 1:
            raise OptionError("A U-Net needs at least two levels of at least one channel; give such widths.")


def _block(inputs: int, outputs: int) -> nn.Sequential:
    """Two 3 x 3 convolutions, each with batch normalisation and ReLU."""
    layers: list[nn.Module] = []
    for channels in (inputs, outputs):
        layers += [
            nn.Conv2d(channels, outputs, 3, padding=1, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        ]
    return nn.Sequential(*layers)


class UNet(nn.Module):
    """Picture [batch, 3, h, w] with values around zero -> logits of `outputs` classes [batch, outputs, h, w].

    The classes do not exclude each other: each has its own probability. h and w must be multiples of `multiple`.
    """

    def __init__(self, options: UNetOptions | None = None, outputs: int = 1):
        super().__init__()
        if not 1 <= outputs <= FINE[0]:
            raise OptionError(f"A U-Net has 1 to {FINE[0]} outputs, not {outputs}.")
        self.outputs = outputs
        widths = (options or UNetOptions()).widths
        self.multiple = FOLD * 2 ** (len(widths) - 1)
        inputs = [3 * FOLD**2, *widths[:-1]]
        self.down = nn.ModuleList(_block(i, o) for i, o in zip(inputs, widths, strict=True))
        self.up = nn.ModuleList(_block(fine + coarse, fine) for fine, coarse in pairwise(widths))
        self.head = nn.Conv2d(widths[0], FINE[0] * FOLD**2, 1)
        self.edges = nn.Sequential(
            nn.Conv2d(3 + FINE[0], FINE[1], 3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(FINE[1], outputs, 3, padding=1),
        )
        for value in self.parameters():  # a copy to(memory_format=...) would do the same
            if value.ndim == 4:
                value.data = value.data.contiguous(memory_format=torch.channels_last)

    def forward(self, picture: Float[torch.Tensor, "batch 3 h w"]) -> Float[torch.Tensor, "batch outputs h w"]:
        """See the class."""
        levels = [self.down[0](functional.pixel_unshuffle(picture, FOLD))]
        for block in self.down[1:]:
            levels.append(block(functional.max_pool2d(levels[-1], 2)))
        x = levels.pop()
        for block in reversed(self.up):
            finer = levels.pop()
            x = block(torch.cat([functional.interpolate(x, scale_factor=2.0, mode="nearest"), finer], dim=1))
        fine = functional.pixel_shuffle(self.head(x), FOLD)
        return fine[:, : self.outputs] + self.edges(torch.cat([picture, fine], dim=1))


def parameters(network: nn.Module) -> int:
    """Number of learned numbers."""
    return sum(p.numel() for p in network.parameters())
