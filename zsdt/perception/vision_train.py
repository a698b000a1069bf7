"""Training of the segmentation: crops, binary cross-entropy and Dice, the best weights on held-out pictures kept."""

from __future__ import annotations

import csv
import logging
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch.nn import functional
from tqdm import tqdm

from zsdt.errors import DataError, OptionError
from zsdt.files import atomic_path
from zsdt.perception.segmentation import EagerNetwork, Segmenter, UNetSegmenter, has_bfloat16, load_segmenter
from zsdt.perception.unet import UNet, UNetOptions, parameters
from zsdt.perception.unet_weights import load_unet, save_unet, unet_card
from zsdt.perception.vision_augment import Augmentation, random_crop
from zsdt.perception.vision_data import LabelledImages, Mask
from zsdt.perception.vision_strangers import face_of

log = logging.getLogger(__name__)


@dataclass
class VisionOptions:
    """How the segmentation is trained.

    images: painted pictures of the virtual lab (0: none). folder: pictures and masks of one's own (see
    `zsdt.perception.vision_data.read_folder`), category: the class of the lines if they are COCO polygons with several.
    start: folder of weights to go on from (fine-tuning). steps of `batch` crops of `crop` px, at a rate that rises to
    learning_rate and falls along a cosine. held_out: share of the pictures by which the best weights are chosen,
    every check_every steps. mixed: convolutions in bfloat16 on processors that have it, which takes half the time;
    others compute in single precision all the same.
    """

    images: int = 200
    folder: str | None = None
    category: str | None = None
    start: str | None = None
    steps: int = 3000
    crop: int = 256
    batch: int = 5
    learning_rate: float = 3e-3
    weight_decay: float = 1e-4
    held_out: float = 0.12
    check_every: int = 300
    seed: int = 0
    mixed: bool = True
    network: UNetOptions = field(default_factory=UNetOptions)
    augmentation: Augmentation = field(default_factory=Augmentation)

    def __post_init__(self) -> None:
        if self.images < 0 or (self.images == 0 and self.folder is None):
            raise OptionError("Nothing to learn from: give a number of painted images, a folder of pictures, or both.")
        if min(self.steps, self.batch, self.check_every) < 1 or self.learning_rate <= 0:
            raise OptionError("steps, batch and check_every must be at least 1, and learning_rate above 0.")
        if self.crop < 64 or self.crop % 32:
            raise OptionError("crop must be a multiple of 32, at least 64.")
        if not 0 < self.held_out < 1:
            raise OptionError("held_out must lie between 0 and 1.")


def train_segmenter(data: LabelledImages, options: VisionOptions, out: str | Path) -> dict[str, Any]:
    """Trains on `data` and writes `unet.pt`, `unet.json` and `training.csv` into the folder `out`.

    Starts from the weights in `options.start` where given. Returns the card: IoU on the held-out pictures, number of
    pictures, options, seconds. Raises: DataError for too few pictures or weights that do not fit.
    """
    out = Path(out)
    began = time.perf_counter()
    learned, judged = data.held_out(options.held_out, options.seed)
    network = _start(options)
    rows = _optimise(network, learned, judged, options)
    card = {
        "iou_held_out": max(row["iou"] for row in rows),
        "pictures": len(learned),
        "pictures_held_out": len(judged),
        "parameters": parameters(network),
        "precision": "bfloat16" if options.mixed and has_bfloat16() else "float32",
        "options": asdict(options),
    }
    save_unet(out, network, options.network, card)
    # What counts is what the stored, rounded weights do.
    card["iou_held_out"] = mean_iou(load_segmenter(out), judged)
    save_unet(out, network, options.network, card)
    write_rows(out / "training.csv", rows)
    seconds = time.perf_counter() - began
    log.info("segmentation: IoU %.3f on %d held-out pictures, %.0f s", card["iou_held_out"], len(judged), seconds)
    return {**card, "seconds": seconds}


def _start(options: VisionOptions) -> UNet:
    torch.manual_seed(options.seed)
    if options.start is None:
        return UNet(options.network)
    if list(unet_card(options.start)["widths"]) != list(options.network.widths):
        raise DataError(
            f"The weights in {options.start} have the widths {unet_card(options.start)['widths']}, not "
            f"{options.network.widths}; set network.widths to theirs."
        )
    return load_unet(options.start)


def _optimise(
    network: UNet, learned: LabelledImages, judged: LabelledImages, options: VisionOptions
) -> list[dict[str, Any]]:
    """Leaves the best weights in `network`; returns a row (step, loss, iou) for every check."""
    optimizer = torch.optim.AdamW(network.parameters(), lr=options.learning_rate, weight_decay=options.weight_decay)
    rng = np.random.default_rng([options.seed, 1])
    faces = [face_of(mask) for mask in learned.masks]
    half = options.mixed and has_bfloat16()
    rows: list[dict[str, Any]] = []
    best: dict[str, torch.Tensor] = {}
    total, since = 0.0, 0
    bar = tqdm(range(options.steps), desc="segmentation", unit="step", dynamic_ncols=True)
    network.train()
    for step in bar:
        for group in optimizer.param_groups:
            group["lr"] = options.learning_rate * learning_rate_factor(step / options.steps)
        crops, paint = batch_of(learned, faces, options, rng)
        with torch.autocast("cpu", torch.bfloat16, enabled=half):
            logit = network(crops)
        loss = segmentation_loss(logit.float(), paint)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
        total, since = total + float(loss.detach()), since + 1
        if (step + 1) % options.check_every == 0 or step + 1 == options.steps:
            network.eval()
            row = {
                "step": step + 1,
                "loss": total / since,
                "iou": mean_iou(UNetSegmenter(EagerNetwork(network), network.multiple), judged),
            }
            network.train()
            rows.append(row)
            bar.set_postfix(loss=f"{row['loss']:.3f}", iou=f"{row['iou']:.3f}")
            if row["iou"] >= max(r["iou"] for r in rows):
                best = {name: value.clone() for name, value in network.state_dict().items()}
            total, since = 0.0, 0
    network.load_state_dict(best)
    network.eval()
    return rows


def learning_rate_factor(progress: float) -> float:
    """Factor of the learning rate: up in the first 5 %, then down along a cosine."""
    return min(progress / 0.05 + 0.05, 1.0) * (0.005 + 0.995 * 0.5 * (1 + math.cos(math.pi * progress)))


def batch_of(
    data: LabelledImages, faces: Sequence[Mask], options: VisionOptions, rng: np.random.Generator
) -> tuple[Float[torch.Tensor, "batch 3 size size"], Float[torch.Tensor, "batch 1 size size"]]:
    """Random crops of random pictures, channels last, and the painted share of their pixels."""
    crops, paints = [], []
    for k in rng.integers(len(data), size=options.batch):
        crop, paint = random_crop(data.images[k], data.masks[k], faces[k], options.crop, options.augmentation, rng)
        crops.append(crop)
        paints.append(paint)
    pictures = torch.from_numpy(np.stack(crops)).permute(0, 3, 1, 2)  # channels last in memory
    return pictures, torch.from_numpy(np.stack(paints))[:, None]


def segmentation_loss(
    logit: Float[torch.Tensor, "batch 1 h w"], paint: Float[torch.Tensor, "batch 1 h w"]
) -> Float[torch.Tensor, ""]:
    """Binary cross-entropy plus one minus the Dice coefficient; lines are few, so the Dice balances."""
    share = torch.sigmoid(logit)
    dice = (2 * (share * paint).sum() + 1) / (share.sum() + paint.sum() + 1)
    return functional.binary_cross_entropy_with_logits(logit, paint) + 1 - dice


def iou_of(probability: Float[np.ndarray, "h w"], mask: np.ndarray) -> float:
    """Intersection over union (seed, IoU) of paint at half coverage; 1 where neither shows any."""
    seen, true = probability > 0.5, mask > 127
    union = int((seen | true).sum())
    return float((seen & true).sum() / union) if union else 1.0


def mean_iou(segmenter: Segmenter, data: LabelledImages) -> float:
    """Mean IoU over pictures."""
    pairs = zip(data.images, data.masks, strict=True)
    return float(np.mean([iou_of(segmenter.probability(image), mask) for image, mask in pairs]))


def iou_against_images(
    data: LabelledImages,
    judged: LabelledImages,
    counts: Sequence[int],
    options: VisionOptions,
    out: str | Path,
) -> list[dict[str, Any]]:
    """Trains anew on the first `counts` pictures each, with the same number of steps; IoU on `judged`.

    Returns a row (images, iou, iou_worst, iou_held_out) per count and writes them to `out/iou_against_images.csv`.
    Raises: DataError where there are fewer pictures than a count asks for.
    """
    if max(counts) > len(data):
        raise DataError(f"A table up to {max(counts)} pictures needs as many, there are {len(data)}.")
    rows = []
    for count in counts:
        folder = Path(out) / f"images_{count}"
        card = train_segmenter(data.pick(range(count)), options, folder)
        segmenter = load_segmenter(folder)
        each = [iou_of(segmenter.probability(i), m) for i, m in zip(judged.images, judged.masks, strict=True)]
        rows.append(
            {
                "images": count,
                "iou": float(np.mean(each)),
                "iou_worst": float(min(each)),
                "iou_held_out": card["iou_held_out"],
            }
        )
        log.info("%d pictures: IoU %.3f", count, rows[-1]["iou"])
    write_rows(Path(out) / "iou_against_images.csv", rows)
    return rows


def write_rows(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """A CSV file of rows of the same names."""
    with atomic_path(path) as beside, beside.open("w", newline="") as lines:
        writer = csv.DictWriter(lines, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
