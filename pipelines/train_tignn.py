"""Stage `train_tignn`: the learned engine, and its rivals (a black box, another form) under the same data."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from omegaconf import DictConfig

from pipelines.stages import Stage, suggestion
from zsdt.errors import OptionError

READS = ("tignn", "training")
SUBSTEPS = ("cell", "particle")  # forms with options of their own, under their own name
SEED = ("form", "passes", "width", "hidden_layers", "shared_weights", "lambda_d", "liquid")  # what form=seed reads


def rivals(config: DictConfig) -> dict[str, DictConfig]:
    """Configs of the rivals: that of the experiment with the changes under ``rivals.<name>`` (null: none).

    Raises: OptionError where a change is not one of the network or its training.
    """
    found = {}
    for name, changes in config.rivals.items():
        if changes is None:
            continue
        for part in changes:
            if part not in READS:
                raise OptionError(f"There is no option 'rivals.{name}.{part}'{suggestion(str(part), READS)}")
        found[str(name)] = config.copy()
        found[str(name)].merge_with(changes)
        found[str(name)].warm_start = None
    return found


def narrow(read: dict[str, Any]) -> dict[str, Any]:
    """The options that count: each form reads its own, and lambda_d weighs the penalty of the soft bracket alone."""
    tignn, training = dict(read["tignn"]), dict(read["training"])
    if training["devices"] == 1:
        del training["devices"]  # several add floats in another order, so they are another result; one is as ever
    form = tignn["form"]
    if form in SUBSTEPS:
        return {"tignn": {"form": form, form: tignn[form]}, "training": {"seed": training["seed"]}}
    if form == "seed":
        return {"tignn": {name: tignn[name] for name in SEED}, "training": training}
    tignn = {name: value for name, value in tignn.items() if name not in SUBSTEPS}
    if tignn["bracket"] != "soft":
        del tignn["lambda_d"]
    return {"tignn": tignn, "training": training}


def elsewhere(config: DictConfig) -> dict[str, str]:
    """The other run whose weights the training starts from, if one is named."""
    return {"warm_start": config.warm_start} if config.warm_start else {}


def run(cfg: SimpleNamespace, inputs: dict[str, Path], out: Path, scratch: Path) -> dict[str, Any]:
    """Trains one engine; a killed training goes on from its last checkpoint in `scratch`."""
    from zsdt.tignn.train import train_engine

    return train_engine(inputs["dataset"], cfg.tignn, cfg.training, out, scratch, inputs.get("warm_start"))


STAGE = Stage(
    "train_tignn",
    1,
    READS,
    run,
    inputs=("dataset",),
    ignores=("training.tensorboard", "training.checkpoint_every"),
    narrow=narrow,
    variants=rivals,
    elsewhere=elsewhere,
)
