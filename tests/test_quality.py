"""Tests of deterministic bounds on accuracy, with recordings and synthetic rooms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from sceneprint.formats.dataset import find_sequences
from sceneprint.geometry.retrieval.ranking import cross_distances
from sceneprint.geometry.signature.fisher_vector import quantise
from sceneprint.pipeline import distance, sign
from sceneprint.signing import (
    describe,
    exact_statistics,
    float_signature,
    open_signer,
    table_statistics,
)
from sceneprint_lab.evaluation.protocol import overlaps, view_of

#: Of the recording, for the database and for queries.
SPLIT = (range(0, 600, 8), range(650, 1000, 8))


def ranks(rows):
    """Database indices by rising distance, ties by index."""
    return np.argsort(rows, axis=1, kind="stable")


def recall_at_10(stored, exact):
    """Share of the exact first ten that stored signatures keep among their first ten."""
    kept = [
        len(set(a[:10]) & set(b[:10])) / 10
        for a, b in zip(ranks(stored), ranks(exact), strict=True)
    ]
    return float(np.mean(kept))


@pytest.fixture(scope="module", params=[pytest.param("paper", marks=pytest.mark.thorough), "depth"])
def signer(request):
    return open_signer(request.param)


@pytest.fixture(scope="module")
def paper():
    return open_signer("paper")


def test_the_table_keeps_the_distances_of_the_exact_path(data_root, signer):
    """Twelve real frames of three sensors; fewer patches only so that the oracle ends soon."""
    p = signer.model.parameters
    p = replace(p, segmentation=replace(p.segmentation, n_patches=200))
    frames = []
    recordings = (
        ("7scenes/redkitchen", 150, 6),
        ("tum/fr1_rpy", 120, 3),
        ("sun3d/studyroom2", 33, 3),
    )
    for name, step, count in recordings:
        references = [frame for part in find_sequences(data_root / name) for frame in part.frames]
        frames += [reference.read() for reference in references[::step][:count]]
    levels = [describe(frame, p).levels for frame in frames]
    table = [
        float_signature([table_statistics(x, signer) for x in h], signer.model) for h in levels
    ]
    exact = [
        float_signature([exact_statistics(x, signer.model) for x in h], signer.model)
        for h in levels
    ]
    assert len(frames) == 12
    table, exact = (pdist(np.stack(rows), "cityblock") for rows in (table, exact))
    assert np.corrcoef(table, exact)[0, 1] >= 0.995


def test_retrieval(data_root, paper):
    """Every fourth frame of a split of docs/model.md: .604, .84."""
    (sequence,) = find_sequences(data_root / "7scenes/redkitchen")
    database, queries = ([sequence.frames[i].read_depth() for i in part] for part in SPLIT)
    d, q = psi_of(database, paper), psi_of(queries, paper)
    step, metric = paper.model.quantiser_step, paper.model.metric
    stored = cross_distances(quantise(q, step), quantise(d, step), metric).astype(float)
    exact = np.stack([np.abs(d - signature).sum(axis=1) for signature in q])
    truth = overlaps([view_of(f) for f in queries], [view_of(f) for f in database]).mean
    first = np.take_along_axis(truth, ranks(stored), axis=1)[:, 0]
    assert truth.max(axis=1).mean() == pytest.approx(0.630, abs=0.002)
    assert first.mean() >= 0.59
    assert (first >= 0.5).mean() >= 0.81
    assert (first >= 0.3).mean() >= 0.97
    assert recall_at_10(stored, exact) >= 0.99


def psi_of(frames, signer):
    """(N, D) psi before any rounding."""
    results = []
    for frame in frames:
        patches = describe(frame, signer.model.parameters).levels
        statistics = [table_statistics(patches[level], signer) for level in signer.model.levels]
        results.append(float_signature(statistics, signer.model, frame.name))
    return np.stack(results)


def test_another_rooms_frame_is_farther(signer, room_frames):
    signed = [sign(frame, signer) for frame in room_frames]
    across = [distance(a, b) for a in signed[:3] for b in signed[3:]]
    assert np.median(across) / signer.model.unrelated_distance == pytest.approx(1.0, abs=0.25)
