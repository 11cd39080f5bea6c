"""Histograms of times: what they add up to, and how far their quantiles are off."""

from __future__ import annotations

import numpy as np
import pytest

from sceneprint.process import BINS, FIRST_S, STEP, Latencies, bin_of, merged, quantile


@pytest.mark.parametrize("spread", [0.3, 1.0, 2.0])
def test_quantiles_of_several_processes_are_those_of_all_times(spread):
    rng = np.random.default_rng(3)
    times = np.exp(rng.normal(np.log(0.08), spread, 5000)).clip(FIRST_S, 600)
    processes = [Latencies() for _ in range(3)]
    for i, one in enumerate(times):
        processes[i % 3].add(float(one))
    together = merged([one.as_json() for one in processes])
    assert sum(together.values()) == 5000
    for share in (0.5, 0.95, 0.99, 1.0):
        exact = float(np.quantile(times, share, method="inverted_cdf"))
        found = quantile(together, share)
        assert found is not None
        # the middle of a bin is at most half a bin from whatever is in it
        assert abs(np.log(found / exact)) <= np.log(STEP) / 2 + 1e-9


def test_bins_meet_without_a_gap():
    for place in range(1, BINS - 1):
        lower = FIRST_S * STEP**place
        assert (bin_of(lower * 1.0001), bin_of(lower * 0.9999)) == (place, place - 1)
    assert (bin_of(0.0), bin_of(-1.0), bin_of(1e9)) == (0, 0, BINS - 1)


def test_of_nothing_there_is_no_quantile():
    assert quantile({}, 0.5) is None
    assert merged([]) == {}
    one = Latencies()
    one.add(0.25)
    for share in (0.0, 0.5, 1.0):  # of one answer it is that answer
        found = quantile(merged([one.as_json()]), share)
        assert found is not None
        assert 0.9 < found / 0.25 < 1.1
