"""Fixtures of the index tests: signatures of walks through a synthetic place."""

import numpy as np
import pytest

from sceneprint.index.index_version import publish


@pytest.fixture(scope="session")
def walk():
    """A function that returns signatures (n, length) of a camera on smooth walks, without clusters.

    Sixteen slow sinusoids of random periods are the position of the camera. A fixed nonlinear map
    of low rank converts them to bytes, each with its own noise.
    """

    def make(n, length=256, seed=0, walks=1):
        place = np.random.default_rng(99)
        mix, fold = place.normal(size=(16, 48)), place.normal(size=(48, length))
        rng = np.random.default_rng(seed)
        parts = []
        for steps in np.array_split(np.arange(n), walks):
            periods = rng.uniform(150, 900, 16)
            angles = 2 * np.pi * (np.arange(len(steps))[:, None] / periods + rng.random(16))
            parts.append(np.abs(np.tanh(np.sin(angles) @ mix / 2) @ fold) * 9)
        smooth = np.concatenate(parts)
        noisy = smooth + rng.normal(size=smooth.shape) * 4 + 12
        return np.clip(noisy, 0, 255).astype(np.uint8)

    return make


@pytest.fixture
def published(tmp_path):
    """A function that publishes keys and signatures as the next version of a folder."""

    def run(
        keys,
        signatures,
        previous=None,
        folder=tmp_path / "map",
        revision=0,
        drop=frozenset(),
        **more,
    ):
        version = publish(
            folder,
            model_id="model",
            revision=revision,
            blocks=[(keys, signatures)],
            previous=previous,
            drop=drop,
            **more,
        )
        assert version is not None
        return version

    return run


@pytest.fixture(scope="session")
def nearest():
    """A function that returns the nearest keys and distances by sorting all sums."""

    def find(query, frames, size):
        request = query.astype(np.int64)
        actual = sorted(
            (int(((x.astype(np.int64) - request) ** 2).sum()), k) for k, x in frames.items()
        )
        return [k for _, k in actual[:size]], [d for d, _ in actual[:size]]

    return find
