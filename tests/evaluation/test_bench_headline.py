"""The short table: every method once, by its best variant and fastest backend, the worst methods not left out."""

from zsdt.evaluation.bench_headline import headline_table


def row(method, error, ms, backend="eager", scene="glass", resolution=1.0, trained=1):
    errors = {"displacement_rrmse": error, "velocity_rrmse": error, "energy_increment_rrmse": error}
    worst = {f"{name}_worst": 2 * value for name, value in errors.items()}
    card = {"scene": scene, "regime": "r", "method": method, "backend": backend, "ms_p50": ms}
    return {**card, **errors, **worst, "resolution": resolution, "trained": trained}


def test_every_method_stands_once_best_first_and_the_worst_last():
    rows = [
        row("poor", 3.0, 9.0),
        row("good", 0.05, 4.0, "eager"),
        row("good", 0.05, 2.0, "kernel"),
        row("good", 0.20, 1.0, "kernel"),  # a cheaper variant with a larger error does not stand for it
        row("good", 0.01, 1.0, resolution=2.0),  # another resolution is another method
        row("untrained", 0.0, 0.1, trained=0),
        row("poor", 2.0, 8.0, scene="beam"),
    ]
    lines = headline_table(rows).splitlines()[2:]
    assert lines == [
        "| glass, r | good (kernel) | 5 (10) | 5 (10) | 5 (10) | 2 |",
        "| glass, r | poor (eager) | 300 (600) | 300 (600) | 300 (600) | 9 |",
        "| beam, r | poor (eager) | 200 (400) | 200 (400) | 200 (400) | 8 |",
    ]
