"""A recording shows when its twin is not to be believed: curves, a frame around the picture, and words."""

from dataclasses import replace

import numpy as np
import pandas as pd

from tests.twin.made_up_run import FRAMES, made_up_run, pictures_of
from zsdt.twin import twin_recording
from zsdt.twin.trust import TrustReading, TrustSeries, summary_of
from zsdt.twin.trust_limits import Flag
from zsdt.twin.verification import verify_recording


def made_up_trust(frames=FRAMES, first=4, last=7):
    """Trusted, then out of range from `first` to `last`, then trusted again."""
    readings = []
    for k in range(frames):
        share = {Flag.range: 0.2 + 0.2 * k, Flag.energy: 0.1}
        if first <= k <= last:
            readings.append(TrustReading((Flag.range,), {"rate": 3.0}, {"rate": 2.0}, share))
        else:
            readings.append(TrustReading((), {"rate": 1.0}, {}, share))
    return TrustSeries.of(readings)


def test_a_recording_tells_where_it_is_not_to_be_believed(tmp_path):
    closed, _, truth = made_up_run()
    shown = replace(closed, trust=made_up_trust())
    twin_recording.record_twin(tmp_path / "twin.rrd", shown, pictures_of(truth), truth)
    entities = verify_recording(tmp_path / "twin.rrd")["entities"]
    assert entities["/plots/trust/range"] == entities["/plots/trust/limit"] == FRAMES
    assert entities["/log/trust"] == 3 and entities["/world/camera/trust"] == 3  # trusted, not, trusted again


def test_words_and_figures_of_a_run():
    series = made_up_trust()
    assert series.first_flag == 4 and series.count() == {"range": 4}
    assert series.reasons[4] == "range: rate 3 (limit 2)" and series.reasons[3] == ""
    assert summary_of(series).startswith(f"Not trusted in 4 of {FRAMES} frames")
    assert series.figures() == {"frames": FRAMES, "flagged": 4, "first": 4, "range": 4}
    assert np.all(series.shares["energy"] == 0.1) and isinstance(pd.Series(series.flags)[4], str)
