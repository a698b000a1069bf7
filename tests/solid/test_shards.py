"""A data set made in pieces is, put together, bitwise the one that is made at once."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from zsdt.errors import DataError, OptionError
from zsdt.fluid.sampler import LiquidSynthesisOptions
from zsdt.fluid.sampler import plan as plan_liquids
from zsdt.solid import dataset
from zsdt.solid.sampler import SizeRange, SynthesisOptions
from zsdt.workers import Shard, take_pieces

TINY = SynthesisOptions(
    train=2,
    val=0,
    test=1,
    beyond=1,
    sizes=SizeRange([35, 40], [10, 10], [10, 10]),
    beyond_sizes=SizeRange([35, 45], [10, 10], [10, 10]),
    hand_duration=0.05,
    dynamic_duration=0.03,
    mesh=0.05,
    seed=3,
)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize("of", [1, 2, 3, 7])
def test_every_job_is_in_exactly_one_piece_and_pieces_cost_about_the_same(of: int) -> None:
    jobs = [SimpleNamespace(name=f"job_{k:03d}", cost=1.0 + k % 5) for k in range(40)]
    shares = [Shard(k, of).share(jobs, lambda job: job.cost) for k in range(1, of + 1)]
    assert Counter(job.name for share in shares for job in share) == Counter(job.name for job in jobs)
    costs = [sum(job.cost for job in share) for share in shares]
    assert max(costs) - min(costs) <= 5.0, "never apart by more than the dearest job"
    assert shares[0] == [job for job in jobs if job in shares[0]], "in the order of the plan"


def test_liquids_are_dealt_out_by_the_same_rule() -> None:
    jobs = plan_liquids(LiquidSynthesisOptions(train=5, val=2, test=3, beyond=2))
    shares = [Shard(k, 4).share(jobs, lambda job: float(job.number)) for k in (1, 2, 3, 4)]
    assert sorted(job.name for share in shares for job in share) == sorted(job.name for job in jobs)


@pytest.mark.parametrize("text", ["0/2", "3/2", "2", "a/b", "-1/2", "1/0", ""])
def test_what_is_no_piece_is_refused(text: str) -> None:
    with pytest.raises(OptionError, match="write i/n"):
        Shard.parse(text)


def test_pieces_put_together_are_the_data_set_that_is_made_at_once(tmp_path: Path) -> None:
    whole = dataset.generate(TINY, tmp_path / "whole")
    pieces = []
    for number in (1, 2, 3):
        pieces.append(tmp_path / f"piece_{number}")
        made = dataset.generate(TINY, pieces[-1], shard=Shard(number, 3))
        assert made["trajectories"] == len(list((pieces[-1] / "trajectories").glob("*.h5"))) in (1, 2)
    take_pieces(pieces[:2], tmp_path / "merged")  # the third is lost: what it held is made anew
    merged = dataset.generate(TINY, tmp_path / "merged")
    assert contents(tmp_path / "merged") == contents(tmp_path / "whole")
    same = ("trajectories", "frames", "simulated_s", "rejections")
    assert [merged[name] for name in same] == [whole[name] for name in same]

    other = tmp_path / "other"
    dataset.generate(replace(TINY, seed=4), other, shard=Shard(1, 4))
    with pytest.raises(DataError, match="other options"):
        take_pieces([pieces[0], other], tmp_path / "mixed")
    source = next((pieces[0] / "trajectories").iterdir())
    target = tmp_path / "forged" / "trajectories" / source.name
    target.parent.mkdir(parents=True)
    target.write_bytes(source.read_bytes()[:-1])
    (tmp_path / "forged" / "options.json").write_text((pieces[0] / "options.json").read_text())
    with pytest.raises(DataError, match="differs from the same trajectory"):
        take_pieces([pieces[0], tmp_path / "forged"], tmp_path / "twice")
