"""Fixtures of the recording tests: a drive, and its camera images."""

import numpy as np
import pytest


@pytest.fixture(scope="session")
def walk(ros):
    """Poses of a base that drives along a bend, every tenth of a second."""
    return [
        (
            0.1 * i,
            ros.transform(0.12 * i, 0.01 * i * i, 0.0, 0, 0, np.sin(0.03 * i), np.cos(0.03 * i)),
        )
        for i in range(21)
    ]


@pytest.fixture(scope="session")
def depth():
    """A function that returns the samples of a frame in millimetres, some of them missing."""

    def samples(i):
        rng = np.random.default_rng(i)
        result = rng.integers(800, 6000, (60, 80)).astype(np.uint16)
        result[rng.random(result.shape) < 0.1] = 0
        return result

    return samples
