"""What the fit of a real beam takes for granted, varied one by one: does a prediction hang on a choice?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from zsdt.errors import RunRejected
from zsdt.evaluation.silicone import MESH, compare, material_of, material_options, predict_fem
from zsdt.interop.silicone_beam import SiliconeRecording
from zsdt.solid.characterise import CharacteriseOptions
from zsdt.solid.prony import PronyChoice
from zsdt.solid.specimen import HungAt


@dataclass(frozen=True)
class Choice:
    """A variant of the fit and the prediction."""

    name: str
    options: CharacteriseOptions
    mesh: float = MESH
    hung_at: HungAt = HungAt.top


def choices(recording: SiliconeRecording) -> list[Choice]:
    """The default and what else could have been taken; `recording` is the one without a mass."""
    usual = material_options(recording)
    return [
        Choice("default", usual),
        Choice("g1 and tau from the static modulus", replace(usual, prony=PronyChoice.static_ratio)),
        Choice("modulus from the static shape alone", replace(usual, straight_sd=0.0)),
        Choice("tau given, 0.1 s", replace(usual, prony=PronyChoice.given_tau, tau=0.1)),
        Choice("tau given, 0.005 s", replace(usual, prony=PronyChoice.given_tau, tau=0.005)),
        Choice("Poisson 0.3", replace(usual, poisson=0.3)),
        Choice("Poisson 0.499", replace(usual, poisson=0.499)),
        Choice("mesh 5 mm", usual, mesh=0.005),
        Choice("mass on the whole tip face", usual, hung_at=HungAt.face),
        Choice("mass on the lower tip edge", usual, hung_at=HungAt.bottom),
    ]


def choice_row(choice: Choice, free: SiliconeRecording, loaded: Sequence[SiliconeRecording]) -> dict[str, object]:
    """The material by a choice and its errors [%] on the recordings with a mass; a refusal is a row as well."""
    row: dict[str, object] = {"choice": choice.name}
    try:
        estimate = material_of(free, choice.options, choice.mesh)
    except RunRejected as refusal:
        return row | {"refused": refusal.cause}
    material = estimate.material
    row |= {
        "relaxed young kPa": 1e-3 * estimate.relaxed_young,
        "static young kPa": 1e-3 * estimate.static_young,
        "storage young kPa": 1e-3 * estimate.storage_young,
        "g1": material.g1,
        "tau ms": 1e3 * material.tau,
    }
    for recording in (free, *loaded):
        errors = compare(recording, predict_fem(recording, material, choice.mesh, choice.hung_at))
        row |= {
            f"{recording.name} drop %": errors["drop error %"],
            f"{recording.name} Hz %": errors["frequency error %"],
            f"{recording.name} damping": errors["predicted damping"],
        }
    return row | {"refused": ""}
