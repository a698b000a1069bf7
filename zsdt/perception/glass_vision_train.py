"""Training of the segmentation of glasses: windows as the twin cuts them, cross-entropy that looks at borders, Dice.

Every step draws its windows from its own random stream, so that a training that was interrupted goes on from its last
check to the same weights as one that was not.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch.nn import functional
from tqdm import tqdm

from zsdt.errors import DataError, OptionError
from zsdt.files import atomic_path
from zsdt.perception.glass_segmentation import OUTPUTS, SIZE, UNetGlassSegmenter, load_glass_segmenter
from zsdt.perception.glass_vision_augment import GlassAugmentation, random_window
from zsdt.perception.glass_vision_data import LabelledGlasses, no_glasses
from zsdt.perception.glass_vision_score import mean_ious
from zsdt.perception.segmentation import EagerNetwork, has_bfloat16
from zsdt.perception.unet import UNet, UNetOptions, parameters
from zsdt.perception.unet_weights import load_unet, save_unet, unet_card
from zsdt.perception.vision_train import learning_rate_factor, write_rows

log = logging.getLogger(__name__)

RESUME = "resume.pt"
NEAR = 7  # px: width of the band at a border that weighs more
JUDGED = 48  # held-out pictures of a group that a check looks at


@dataclass
class GlassVisionOptions:
    """How the segmentation of glasses is trained.

    images: painted pictures of the virtual lab (0: none). raytraced: ray-traced ones, rendered with the optional extra
    of that name (0: none). folder: pictures and masks, rendered before or one's own (see
    `zsdt.perception.glass_vision_data`). Every kind is drawn equally often. start: folder of weights to go on from
    (fine-tuning). steps of `batch` windows of `size` px, at a rate that rises to learning_rate and falls along a
    cosine. boundary: how much more a pixel at the border of a class counts. held_out: share of the pictures by which
    the best weights are chosen, every check_every steps. averaging: the weights that are judged and kept are a running
    mean over about 1 / (1 - averaging) steps, which held-out pictures like better than those of any one step (Polyak
    and Juditsky 1992; 0: the last step's). mixed: convolutions in bfloat16 on processors that have it.
    """

    images: int = 600
    raytraced: int = 0
    folder: str | None = None
    start: str | None = None
    steps: int = 3000
    size: int = SIZE
    batch: int = 8
    learning_rate: float = 3e-3
    weight_decay: float = 1e-4
    boundary: float = 3.0
    held_out: float = 0.1
    averaging: float = 0.995
    check_every: int = 250
    seed: int = 0
    mixed: bool = True
    network: UNetOptions = field(default_factory=UNetOptions)
    augmentation: GlassAugmentation = field(default_factory=GlassAugmentation)

    def __post_init__(self) -> None:
        if min(self.images, self.raytraced) < 0 or (self.images + self.raytraced == 0 and self.folder is None):
            raise OptionError("Nothing to learn from: give a number of rendered images, a folder of pictures, or both.")
        if min(self.steps, self.batch, self.check_every) < 1 or self.learning_rate <= 0 or self.boundary < 0:
            raise OptionError(
                "steps, batch and check_every must be at least 1, learning_rate above 0, boundary not negative."
            )
        if self.size < 64 or self.size % 32:
            raise OptionError("size must be a multiple of 32, at least 64.")
        if not 0 < self.held_out < 1 or not 0 <= self.averaging < 1:
            raise OptionError("held_out must lie between 0 and 1, averaging too (or be 0).")


@dataclass
class _Progress:
    """What an interrupted training goes on from."""

    step: int
    rows: list[dict[str, Any]]
    best: dict[str, torch.Tensor]
    mean: dict[str, torch.Tensor] = field(default_factory=dict)
    total: float = 0.0


def train_glass_segmenter(
    groups: Sequence[LabelledGlasses],
    options: GlassVisionOptions,
    out: str | Path,
    scratch: str | Path | None = None,
    minutes: float | None = None,
) -> dict[str, Any]:
    """Trains and writes `unet.pt`, `unet.json` and `training.csv` into the folder `out`.

    groups: pictures of one kind each, drawn equally often. scratch: folder in which an interrupted training is kept
    and found again; minutes: this call ends after about so long, at a check, and the next goes on. Returns the card:
    IoU of container and liquid on the held-out pictures, number of pictures, options, finished, seconds of this call.
    Raises: DataError for too few pictures, or weights or an interrupted training that do not fit.
    """
    began = time.perf_counter()
    splits = [group.held_out(options.held_out, options.seed) for group in groups if len(group)]
    if not splits:
        raise DataError("There are no labelled pictures of glasses to learn from; give rendered ones or a folder.")
    learned, judged = [pair[0] for pair in splits], no_glasses()
    for pair in splits:
        judged = judged + pair[1].pick(range(min(JUDGED, len(pair[1]))))
    network = _start(options)
    deadline = None if minutes is None else began + 60 * minutes
    place = None if scratch is None else Path(scratch) / RESUME
    rows, finished = _optimise(network, learned, judged, options, place, deadline)
    card: dict[str, Any] = {
        "size": options.size,
        "pictures": sum(map(len, learned)),
        "pictures_held_out": len(judged),
        "steps_done": rows[-1]["step"],
        "finished": finished,
        "parameters": parameters(network),
        "precision": "bfloat16" if options.mixed and has_bfloat16() else "float32",
        "options": {**asdict(options), **_names(options)},
    }
    save_unet(out, network, options.network, card)
    # What counts is what the stored, rounded weights do.
    container, liquid = mean_ious(load_glass_segmenter(out), judged)
    card |= {"container_iou_held_out": container, "liquid_iou_held_out": liquid}
    save_unet(out, network, options.network, card)
    write_rows(Path(out) / "training.csv", rows)
    seconds = time.perf_counter() - began
    log.info("glasses: IoU container %.3f, liquid %.3f on %d held-out pictures", container, liquid, len(judged))
    return {**card, "seconds": seconds}


def _names(options: GlassVisionOptions) -> dict[str, str | None]:
    """Folders by their names alone: a card travels to machines where their paths mean nothing."""
    return {key: value and Path(value).name for key, value in (("folder", options.folder), ("start", options.start))}


def _start(options: GlassVisionOptions) -> UNet:
    torch.manual_seed(options.seed)
    if options.start is None:
        return UNet(options.network, OUTPUTS)
    if list(unet_card(options.start)["widths"]) != list(options.network.widths):
        raise DataError(
            f"The weights in {options.start} have the widths {unet_card(options.start)['widths']}, not "
            f"{options.network.widths}; set network.widths to theirs."
        )
    return load_unet(options.start, OUTPUTS)


def _optimise(
    network: UNet,
    learned: Sequence[LabelledGlasses],
    judged: LabelledGlasses,
    options: GlassVisionOptions,
    place: Path | None,
    deadline: float | None,
) -> tuple[list[dict[str, Any]], bool]:
    """Leaves the best weights in `network`; returns a row for every check, and whether all steps were done."""
    optimizer = torch.optim.AdamW(network.parameters(), lr=options.learning_rate, weight_decay=options.weight_decay)
    at = _resumed(place, network, optimizer, options) or _Progress(0, [], {})
    half = options.mixed and has_bfloat16()
    bar = tqdm(total=options.steps, initial=at.step, desc="glasses", unit="step", dynamic_ncols=True, disable=None)
    network.train()
    while at.step < options.steps and not (deadline and at.rows and time.perf_counter() > deadline):
        for _ in range(min(options.check_every, options.steps - at.step)):
            for group in optimizer.param_groups:
                group["lr"] = options.learning_rate * learning_rate_factor(at.step / options.steps)
            rng = np.random.default_rng([options.seed, 0x61A5, at.step])
            windows, shares, counts, weights = glass_batch(learned, options, rng)
            with torch.autocast("cpu", torch.bfloat16, enabled=half):
                logit = network(windows)
            loss = glass_loss(logit.float(), shares, counts, weights)
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
            at.step, at.total = at.step + 1, at.total + float(loss.detach())
            _average(at, network, options.averaging)
            bar.update()
        _check(at, network, judged, options)
        bar.set_postfix({name: f"{value:.3f}" for name, value in at.rows[-1].items() if name != "step"})
        if place is not None:
            _keep(place, at, network, optimizer, options)
    bar.close()
    network.load_state_dict(at.best)
    network.eval()
    return at.rows, at.step >= options.steps


def _check(at: _Progress, network: UNet, judged: LabelledGlasses, options: GlassVisionOptions) -> None:
    """Judges the mean of the weights on the held-out pictures and remembers the best."""
    mean = UNet(options.network, OUTPUTS)
    mean.load_state_dict(at.mean)
    container, liquid = mean_ious(UNetGlassSegmenter(EagerNetwork(mean), mean.multiple, options.size), judged)
    since = at.step - (at.rows[-1]["step"] if at.rows else 0)
    known = [value for value in (container, liquid) if np.isfinite(value)]
    score = float(np.mean(known)) if known else 0.0
    row = {"step": at.step, "loss": at.total / since, "container": container, "liquid": liquid, "score": score}
    if not at.rows or score >= max(other["score"] for other in at.rows):
        at.best = {name: value.clone() for name, value in at.mean.items()}
    at.rows.append(row)
    at.total = 0.0


def _average(at: _Progress, network: UNet, averaging: float) -> None:
    """The running mean of weights and of the statistics of normalisation; it forgets the first steps faster."""
    kept = min(averaging, at.step / (10 + at.step))
    for name, value in network.state_dict().items():
        known = at.mean.get(name)
        if known is None or not value.is_floating_point():
            at.mean[name] = value.clone()
        else:
            known.lerp_(value, 1 - kept)


def _keep(
    place: Path, at: _Progress, network: UNet, optimizer: torch.optim.Optimizer, options: GlassVisionOptions
) -> None:
    with atomic_path(place) as beside:
        state = {"progress": asdict(at), "network": network.state_dict(), "optimizer": optimizer.state_dict()}
        torch.save({**state, "options": asdict(options)}, beside)


def _resumed(
    place: Path | None, network: UNet, optimizer: torch.optim.Optimizer, options: GlassVisionOptions
) -> _Progress | None:
    """The interrupted training in `place`; None where there is none."""
    if place is None or not place.is_file():
        return None
    try:
        state = torch.load(place, weights_only=True)
    except Exception as error:  # torch.load raises whatever a broken file makes its readers stumble over
        raise DataError(f"The interrupted training {place} is broken ({error}); remove it to begin anew.") from error
    if state["options"] != asdict(options):
        raise DataError(f"The interrupted training {place} had other options; remove it to begin anew.")
    network.load_state_dict(state["network"])
    optimizer.load_state_dict(state["optimizer"])
    log.info("goes on from step %d", state["progress"]["step"])
    return _Progress(**state["progress"])


def glass_batch(
    groups: Sequence[LabelledGlasses], options: GlassVisionOptions, rng: np.random.Generator
) -> tuple[
    Float[torch.Tensor, "batch 3 size size"],
    Float[torch.Tensor, "batch 2 size size"],
    Float[torch.Tensor, "batch 2 size size"],
    Float[torch.Tensor, "batch 2 size size"],
]:
    """Windows (channels last), shares of container and liquid, whether each pixel of each class counts, and how much
    it weighs: more near a border of its class."""
    windows, shares, counts, weights = [], [], [], []
    for _ in range(options.batch):
        group = groups[int(rng.integers(len(groups)))]
        number = int(rng.integers(len(group)))
        window, share, valid = random_window(group, number, options.size, options.augmentation, rng)
        windows.append(window)
        shares.append(share)
        counts.append(np.stack([valid, valid * np.float32(group.liquid_known[number])]))
        near = np.stack([cv2.blur(one, (NEAR, NEAR)) for one in share])
        weights.append(counts[-1] * (1 + np.float32(4 * options.boundary) * near * (1 - near)))
    pictures = torch.from_numpy(np.stack(windows)).permute(0, 3, 1, 2)  # channels last in memory
    return pictures, *(torch.from_numpy(np.stack(part)) for part in (shares, counts, weights))  # type: ignore[return-value]


def glass_loss(
    logit: Float[torch.Tensor, "batch 2 h w"],
    share: Float[torch.Tensor, "batch 2 h w"],
    count: Float[torch.Tensor, "batch 2 h w"],
    weight: Float[torch.Tensor, "batch 2 h w"],
) -> Float[torch.Tensor, ""]:
    """Binary cross-entropy by weight, plus one minus the Dice over the batch of each class by count."""
    each = functional.binary_cross_entropy_with_logits(logit, share, reduction="none")
    seen = torch.sigmoid(logit) * count
    true = share * count
    over = (0, 2, 3)
    dice = (2 * (seen * true).sum(over) + 1) / (seen.sum(over) + true.sum(over) + 1)
    return (each * weight).sum() / weight.sum().clamp(min=1) + (1 - dice).mean()
