"""Plain tensor operations give what the compiled loops give, so a traced network is the same network."""

import pytest
import torch

from tests.tignn.conftest import batch_in_double, loads_of, make_body, random_state, unit_model
from zsdt.tignn.features import GraphBatch
from zsdt.tignn.options import Bracket, Energy, TignnOptions
from zsdt.tignn.plain_wiring import PlainBatch, wiring_fields

SMALL = {"width": 16, "passes": 2, "local_passes": 1}
CASES = {
    "exact": TignnOptions(**SMALL, history=1),
    "soft": TignnOptions(**SMALL, bracket=Bracket.soft),
    "none": TignnOptions(**SMALL, bracket=Bracket.none, global_context=False),
    "physical": TignnOptions(**SMALL, staggered=False, energy=Energy.physical),
}


def plain(batch: GraphBatch) -> PlainBatch:
    pairs, rows = torch.from_numpy(batch.graph.pairs), torch.from_numpy(batch.halves)
    own = {n: getattr(batch, n) for n in ("arm", "free", "surface", "dt", "pitch", "mass", "volume", "gravity")}
    return PlainBatch(**wiring_fields(batch.free, batch.to, batch.source, pairs, rows), **own)


@pytest.mark.parametrize("case", CASES)
def test_a_step_is_the_same_with_and_without_compiled_loops(case: str) -> None:
    body, options = make_body(), CASES[case]
    model, batch = unit_model(options), batch_in_double(body)
    state, loads = random_state(body, options), loads_of(body)
    with torch.no_grad():
        ours, theirs = (model(b, state, *loads).state for b in (batch, plain(batch)))
    for name, value in vars(ours).items():
        assert torch.allclose(value, getattr(theirs, name), rtol=1e-10, atol=1e-10), name
