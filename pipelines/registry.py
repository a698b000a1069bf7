"""The stages of this program in the order in which data travel, and the application made of them."""

from __future__ import annotations

from pathlib import Path

from pipelines import (
    calibrate_camera,
    characterise,
    evaluate,
    evaluate_twin,
    film,
    import_abaqus,
    synthesize,
    train_psi_ini,
    train_tignn,
    train_vision,
    twin,
)
from pipelines.compose import Application
from pipelines.config import register

STAGES = (
    synthesize.SHARD,
    synthesize.STAGE,
    import_abaqus.STAGE,
    film.STAGE,
    calibrate_camera.STAGE,
    train_vision.STAGE,
    train_psi_ini.STAGE,
    train_tignn.STAGE,
    evaluate.STAGE,
    evaluate_twin.STAGE,
    characterise.STAGE,
    twin.STAGE,
)
APPLICATION = Application(conf=Path(__file__).resolve().parents[1] / "conf", stages=STAGES, register=register)
