"""Training of the learned engine: Lightning module, checkpoints and resume; `choice` says which weights are kept."""

from __future__ import annotations

import copy
import logging
import math
import resource
import shutil
import time
import warnings
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import nn

from zsdt.errors import DataError
from zsdt.files import atomic_path
from zsdt.tignn.choice import ChooseByRollout, Judge, judge_of, read_table
from zsdt.tignn.message_passing import receptive_field
from zsdt.tignn.model import NodeModel
from zsdt.tignn.node_data import NodeData, Sample, SampleStream, clip_of, scales_of
from zsdt.tignn.node_engine import NodeEngine, load_model, save_engine
from zsdt.tignn.options import Bracket, Form, TignnOptions, TrainingOptions
from zsdt.tignn.parallel import portion, settings_here, strategy_for, take_settings
from zsdt.trajectory import Dataset, Trajectory

log = logging.getLogger(__name__)
# Lightning remarks that the stream has one worker and no length; both are meant.
warnings.filterwarnings("ignore", message=".*(does not have many workers|`IterableDataset` has `__len__`).*")


class EngineTraining(L.LightningModule):
    """Optimiser, clipping and averaged weights; who inherits it says what the loss of a sample is."""

    def __init__(self, model: nn.Module, training: TrainingOptions):
        super().__init__()
        self.model, self.training_options = model, training
        self.averaged = copy.deepcopy(model).requires_grad_(False)
        self.totals: dict[str, list[float]] = {}
        self.settings = settings_here()

    def setup(self, stage: str) -> None:
        """Called by Lightning in every process that trains."""
        take_settings(self.settings)

    def combined(self, parts: dict[str, torch.Tensor], penalty: torch.Tensor | None, options: TignnOptions):
        """`lambda_d * data + |M dE|2 + |L dS|2` for soft, the data term for the others; notes all parts."""
        loss = torch.stack(list(parts.values())).sum()
        if options.bracket is Bracket.soft:
            assert penalty is not None
            parts["penalty"] = penalty
            loss = options.lambda_d * loss + penalty
        for name, value in parts.items():
            self.totals.setdefault(name, []).append(float(value.detach()))
        return loss

    def configure_optimizers(self) -> Any:
        """AdamW; the rate warms up, then falls as a cosine to one hundredth."""
        o = self.training_options
        optimizer = torch.optim.AdamW(
            self.model.parameters(), lr=o.learning_rate, weight_decay=o.weight_decay, fused=True
        )

        def rate(step: int) -> float:
            done = step / o.steps
            fall = 0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * min(done, 1.0)))
            return fall * min(1.0, (step + 1) / max(1.0, o.warmup * o.steps))

        scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, rate)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": scheduler, "interval": "step"}}

    def configure_gradient_clipping(
        self, optimizer: Any, gradient_clip_val: float | None = None, gradient_clip_algorithm: str | None = None
    ) -> None:
        """Each half of a step is clipped for itself: they share no weights, and one must not starve the other."""
        for part in self.model.children():
            torch.nn.utils.clip_grad_norm_(part.parameters(), gradient_clip_val or 1.0)

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        """One step, then the averaged weights follow (faster at first, so that early ones are forgotten)."""
        super().optimizer_step(*args, **kwargs)
        keep = min(self.training_options.ema, (1 + self.global_step) / (10 + self.global_step))
        with torch.no_grad():
            for slow, now in zip(self.averaged.parameters(), self.model.parameters(), strict=True):
                slow.lerp_(now, 1.0 - keep)


class NodeTraining(EngineTraining):
    """Loss of the node form of solids."""

    model: NodeModel

    def training_step(self, sample: Sample, index: int) -> torch.Tensor:
        """Push-forward without gradient, then the errors of one step."""
        state, loads = sample.state, sample.loads
        with torch.no_grad():
            for k in range(len(loads) - 2):
                state = self.model(sample.batch, state, loads[k], loads[k + 1]).state
        step = self.model(sample.batch, state, loads[-2], loads[-1])
        error_v = (step.state.velocity - sample.target.velocity).square()
        error_s = (step.state.stress - sample.target.stress).square()
        parts = {
            "velocity": (error_v * sample.velocity_weight).mean(),
            "stress": (error_s * sample.stress_weight).mean(),
        }
        if self.model.thermal:
            error_w = (step.state.thermal - sample.target.thermal) / self.model.scales.d_thermal
            parts["thermal"] = error_w.square().mean()
        share = portion(len(error_v))
        penalty = None if step.penalty is None else share * step.penalty
        return self.combined({name: share * part for name, part in parts.items()}, penalty, self.model.options)


class AtomicCheckpoints(TorchCheckpointIO):
    """Lightning's checkpoints, moved into place when complete: a kill never leaves half of one."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None) -> None:
        """Writes beside and replaces."""
        with atomic_path(path) as beside:
            torch.save(checkpoint, beside)


def split_held(dataset: Dataset, training: TrainingOptions) -> tuple[list[Trajectory], list[Trajectory]]:
    """Training trajectories, and those kept aside to choose the checkpoint.

    Raises: DataError where a name in `holdout` is not a training trajectory or nothing is left to train on.
    """
    entries = dataset.split("train")
    names = training.holdout or [e.name for e in entries[len(entries) - training.holdout_count :]]
    unknown = set(names) - {e.name for e in entries}
    if unknown:
        raise DataError(f"holdout names {', '.join(sorted(unknown))}, which are no training trajectories; correct it.")
    if len(names) >= len(entries):
        raise DataError(f"{len(names)} of {len(entries)} training trajectories are held out; leave some to train on.")
    read = {e.name: dataset.read(e) for e in entries}
    return [t for n, t in read.items() if n not in names], [read[n] for n in names]


def begin_training(
    dataset_folder: str | Path, training: TrainingOptions, scratch: Path
) -> tuple[list[Trajectory], list[Trajectory]]:
    """Makes `scratch`, seeds all generators of random numbers, and splits the data; see `split_held`."""
    scratch.mkdir(parents=True, exist_ok=True)
    L.seed_everything(training.seed, verbose=False)
    return split_held(Dataset(dataset_folder), training)


def train_node(
    dataset_folder: str | Path,
    options: TignnOptions,
    training: TrainingOptions,
    out: str | Path,
    scratch: str | Path,
    warm_start: str | Path | None = None,
) -> dict[str, Any]:
    """Trains the node form; see `train_engine`."""
    scratch, out = Path(scratch), Path(out)
    train, held = begin_training(dataset_folder, training, scratch)
    model = NodeModel(options, scales_of(train, options))
    if warm_start is not None:
        take_weights(model, load_model(warm_start), warm_start)
    bound = _print_bound(options, train)
    stream = SampleStream([clip_of(t, options) for t in train], model.scales, options, training)
    figures = fit(NodeTraining(model, training), stream, judge_of(NodeEngine, held), scratch, out)
    save_engine(model, out)
    return figures | {"receptive_field": bound, "held_out": [t.name for t in held]}


def fit(module: EngineTraining, stream: Any, judge: Judge | None, scratch: Path, out: Path) -> dict[str, Any]:
    """Trains `module.model` on `stream` (which has `start`, its first step), from the last checkpoint in `scratch` if
    there is one, and leaves it with the weights that `judge` found best; `training.csv` goes into `out`. With
    `devices` > 1 all arguments must be such that they can be sent to other processes.

    Returns figures: steps, seconds per 1,000 steps, CPU-minutes, parameters, errors of the best weights.
    """
    training = module.training_options
    last = scratch / "last.ckpt"
    if last.is_file():
        stream.start = int(torch.load(last, weights_only=False)["global_step"])
        log.info("resuming at step %d", stream.start)
    trainer = _trainer(training, scratch, ChooseByRollout(judge, training, scratch))
    began, began_cpu = time.perf_counter(), _cpu_seconds()
    if stream.start < training.steps:
        trainer.fit(module, NodeData(stream), ckpt_path=str(last) if last.is_file() else None, weights_only=False)
    rows = read_table(scratch / "training.csv")  # of other processes the files are all that comes back
    done = int(rows[-1]["step"])
    steps = max(done - stream.start, 0)
    wall, cpu = time.perf_counter() - began, _cpu_seconds() - began_cpu
    figures: dict[str, Any] = {
        "steps": done,
        "seconds_per_1000_steps": round(1e3 * wall / max(steps, 1), 2),
        "cpu_minutes": round(cpu / 60.0, 3),
        "parameters": sum(p.numel() for p in module.model.parameters()),
    }
    if steps:
        log.info("%.1f s per 1,000 steps", figures["seconds_per_1000_steps"])
    module.model.load_state_dict(torch.load(scratch / "best.pt", weights_only=True))
    best = min(rows, key=lambda row: row["rollout_score"])
    figures["best"] = {k: v for k, v in best.items() if k.startswith("rollout_") or k == "step"}
    out.mkdir(parents=True, exist_ok=True)
    shutil.copy(scratch / "training.csv", out / "training.csv")
    return figures


def _cpu_seconds() -> float:
    """Of this process and of those that it started and that have ended."""
    return time.process_time() + sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])


def _trainer(training: TrainingOptions, scratch: Path, choose: ChooseByRollout) -> L.Trainer:
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)  # no advertisements between the steps
    checkpoint = L.pytorch.callbacks.ModelCheckpoint(
        dirpath=scratch,
        filename="last",
        every_n_train_steps=training.checkpoint_every,
        enable_version_counter=False,
        save_top_k=1,
    )
    logger: Any = False
    if training.tensorboard:
        logger = L.pytorch.loggers.TensorBoardLogger(save_dir=scratch, name="tensorboard", version="")
    return L.Trainer(
        accelerator="cpu",
        devices=training.devices,
        strategy=strategy_for(training.devices),
        max_steps=training.steps,
        max_epochs=-1,
        gradient_clip_val=1.0,
        callbacks=[choose, checkpoint],
        plugins=[AtomicCheckpoints()],
        logger=logger,
        enable_progress_bar=False,
        enable_model_summary=False,
        log_every_n_steps=training.check_every,
    )


def take_weights(model: nn.Module, other: nn.Module, folder: str | Path) -> None:
    """Copies the weights of another run. Raises: DataError where the networks have different shapes."""
    theirs, own = other.state_dict(), model.state_dict()
    if {k: v.shape for k, v in own.items()} != {k: v.shape for k, v in theirs.items()}:
        raise DataError(
            f"The network in {folder} has another shape; warm-start from a run with the same tignn options."
        )
    model.load_state_dict(theirs)


def _print_bound(options: TignnOptions, trajectories: list[Trajectory]) -> str:
    """Depth against what the physics asks for, over all bodies: the hardest is printed."""
    lines = []
    for trajectory in trajectories:
        body = trajectory.body
        speed = None
        if body.material is not None:
            speed = math.sqrt((body.material.bulk + 4.0 / 3.0 * body.material.shear) / body.material.density)
        length = float(np.ptp(body.points[:, 0]))
        line = receptive_field(options.passes, body.pitch, body.frame_dt, length, speed)
        lines.append((length / body.pitch + (speed or 0.0) * body.frame_dt / body.pitch, line))
    hardest = max(lines)[1]
    log.info("receptive field: %s%s", hardest, "; a virtual node spans the graph" if options.global_context else "")
    return hardest


def holds_liquid(dataset_folder: str | Path) -> bool:
    """Whether the bodies of a data set are liquids. Raises: DataError where it has no trajectory."""
    dataset = Dataset(dataset_folder)
    if not dataset.entries:
        raise DataError(f"{dataset_folder} has no trajectories; make the data set with some.")
    return dataset.read(dataset.entries[0]).body.liquid is not None


def train_engine(
    dataset_folder: str | Path,
    options: TignnOptions,
    training: TrainingOptions,
    out: str | Path,
    scratch: str | Path,
    warm_start: str | Path | None = None,
) -> dict[str, Any]:
    """Trains the form of the engine that `options.form` names and writes its artifact into `out`.

    `scratch` keeps checkpoints: a run that was killed goes on from there when it is called again. Returns figures
    (steps, seconds per 1,000 steps, CPU-minutes, error of the chosen weights on what was held out).

    Raises: DataError, OptionError.
    """
    if options.form is Form.cell:
        from zsdt.tignn.cell_train import train_cell

        return train_cell(dataset_folder, options, training, out, scratch, warm_start)
    if options.form is Form.particle:
        from zsdt.tignn.particle_train import train_particle

        return train_particle(dataset_folder, options, training, out, scratch, warm_start)
    if options.form is Form.seed:
        from zsdt.tignn.seed_train import train_seed

        return train_seed(dataset_folder, options, training, out, scratch, warm_start)
    if holds_liquid(dataset_folder):
        from zsdt.tignn.liquid_train import train_liquid

        return train_liquid(dataset_folder, options, training, out, scratch, warm_start)
    return train_node(dataset_folder, options, training, out, scratch, warm_start)
