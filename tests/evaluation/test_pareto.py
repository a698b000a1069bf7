"""The Pareto front against its definition, on random clouds."""

from __future__ import annotations

import numpy as np

from zsdt.evaluation.pareto import pareto_front


def test_front_is_what_nobody_dominates() -> None:
    random = np.random.default_rng(0)
    for _ in range(50):
        costs = random.integers(0, 6, (random.integers(1, 12), 2)).astype(float)
        front = pareto_front(costs)
        for k, mine in enumerate(costs):
            beaten = any((other <= mine).all() and (other < mine).any() for other in costs)
            assert front[k] == (not beaten)
        assert front.any()


def test_front_does_not_depend_on_units_or_order() -> None:
    costs = np.random.default_rng(1).random((20, 2))
    front = pareto_front(costs)
    assert (pareto_front(costs * [1e3, 1e-2]) == front).all()
    order = np.random.default_rng(2).permutation(20)
    assert (pareto_front(costs[order]) == front[order]).all()


def test_a_diverged_method_is_never_on_the_front() -> None:
    costs = np.array([[1.0, 2.0], [0.1, np.nan], [0.1, np.inf], [2.0, 3.0]])
    assert pareto_front(costs).tolist() == [True, False, False, False]
