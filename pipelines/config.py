"""The structured config: options of the rooms under one root, so that a mistyped key fails before anything runs."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING

from pipelines.machine import Machine
from pipelines.options import Baseline, CameraCalibration, GlassTwinRun, TwinParts, TwinRun, Weights
from zsdt.evaluation.beam_twin_cases import TwinEvaluationOptions
from zsdt.evaluation.evaluate import EvaluationOptions
from zsdt.evaluation.glass_twin_cases import GlassTwinEvaluationOptions
from zsdt.fluid.sampler import LiquidSynthesisOptions
from zsdt.interop.abaqus_beams import AbaqusOptions
from zsdt.lab.beam_lab import BeamLabOptions
from zsdt.lab.glass_lab import GlassLabOptions
from zsdt.perception.glass_vision_train import GlassVisionOptions
from zsdt.perception.vision_train import VisionOptions
from zsdt.perception.yolo_glass import YoloOptions
from zsdt.planning.budget import Budget
from zsdt.solid.dataset import SynthesisOptions
from zsdt.tignn.inference import InferenceOptions
from zsdt.tignn.options import TignnOptions, TrainingOptions
from zsdt.tignn.psi_ini import PsiIniOptions
from zsdt.tignn.psi_ini_liquid import LiquidPsiIniOptions
from zsdt.twin.glass_scene import GlassTwinScene
from zsdt.twin.twin_scene import BeamTwinScene


@dataclass
class Config:
    """Root of the config.

    name: of the experiment. stages: which to run; what they need is run as well. data: where the bodies come from
    (group `data`). shard: the piece i/n of them that the stage synthesize_shard makes. psi_ini: network of the
    hidden first state (group `psi_ini`), null for none. tignn, training: the learned engine. warm_start: artifact
    folder or experiment whose weights the training starts from. rivals: name -> changes of tignn and training,
    further engines in the same evaluation. inference: how trained engines are computed there. baselines: methods
    without training in the same evaluation. lab: the virtual laboratory (group `lab`), vision: the segmentation
    (group `vision`), scene: what stands before the camera (group `scene`); null for none. vision_judge: pictures of
    unseen looks by which a segmentation is judged.
    budget: what the scene may cost and how wrong it may be, where twin.plan is set.
    camera: its calibration. twin: one video (group `twin`). twin_evaluation: all clips of the lab (group
    `twin_evaluation`), with weights `twin_weights`. objective: figure that a search minimises, as a dotted path
    into the figures of the summary.
    """

    name: str = MISSING
    stages: list[str] = field(default_factory=lambda: ["evaluate"])
    data: Any = MISSING
    shard: str = "1/1"
    psi_ini: Any = None
    tignn: TignnOptions = field(default_factory=TignnOptions)
    training: TrainingOptions = field(default_factory=TrainingOptions)
    warm_start: str | None = None
    rivals: dict[str, Any] = field(default_factory=dict)
    inference: InferenceOptions = field(default_factory=InferenceOptions)
    baselines: list[Baseline] = field(default_factory=lambda: [Baseline.static])
    evaluation: EvaluationOptions = field(default_factory=EvaluationOptions)
    lab: Any = None
    vision: Any = None
    vision_judge: int = 40
    scene: Any = None
    budget: Budget = field(default_factory=Budget)
    camera: CameraCalibration = field(default_factory=CameraCalibration)
    twin: Any = MISSING
    twin_evaluation: Any = MISSING
    twin_weights: TwinParts = field(
        default_factory=lambda: TwinParts(Weights.shipped, Weights.trained, Weights.trained)
    )
    objective: str = "evaluate.objective"
    machine: Machine = field(default_factory=Machine)


def register() -> None:
    """Puts the schemas where the YAML files find them."""
    store = ConfigStore.instance()
    store.store(name="schema", node=Config)
    store.store(group="data", name="own_beams_schema", node=SynthesisOptions)
    store.store(group="data", name="abaqus_beams_schema", node=AbaqusOptions)
    store.store(group="data", name="liquids_schema", node=LiquidSynthesisOptions)
    store.store(group="psi_ini", name="liquid_schema", node=LiquidPsiIniOptions)
    store.store(group="lab", name="foam_beams_schema", node=BeamLabOptions)
    store.store(group="vision", name="painted_grid_schema", node=VisionOptions)
    store.store(group="scene", name="foam_beam_schema", node=BeamTwinScene)
    store.store(group="psi_ini", name="solid_schema", node=PsiIniOptions)
    store.store(group="twin", name="beam_schema", node=TwinRun)
    store.store(group="twin_evaluation", name="beam_schema", node=TwinEvaluationOptions)
    store.store(group="lab", name="glasses_schema", node=GlassLabOptions)
    store.store(group="vision", name="glass_schema", node=GlassVisionOptions)
    store.store(group="vision", name="yolo_seg_schema", node=YoloOptions)
    store.store(group="scene", name="glass_schema", node=GlassTwinScene)
    store.store(group="twin", name="glass_schema", node=GlassTwinRun)
    store.store(group="twin_evaluation", name="glass_schema", node=GlassTwinEvaluationOptions)
