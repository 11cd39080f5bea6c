"""Retrieval on the splits of 7-Scenes redkitchen: `python -m benchmarks.retrieval SCENE`.

forward: database 0-599 step 2, queries 650-999 step 2; reverse: database 400-999 step 3,
queries 0-349 step 3. Both are hard: the best frame in the database overlaps a query by 0.64
on average.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from sceneprint.datasets import Sequence, find_sequences
from sceneprint.evaluation.overlap import overlaps, view_of
from sceneprint.geometry.encoding import quantise
from sceneprint.geometry.retrieval import cross_distances
from sceneprint.geometry.whitening import UNITS, whiten
from sceneprint.models import Model
from sceneprint.signing import (
    Signer,
    describe,
    float_signature,
    open_signer,
    table_statistics,
)
from sceneprint.types import Bytes, Floats, Frame

SPLITS = {
    "forward": (range(0, 600, 2), range(650, 1000, 2)),
    "reverse": (range(400, 1000, 3), range(0, 350, 3)),
}


@dataclass(frozen=True)
class Figures:
    """What one split gives. `top1_overlap_50`: share of queries whose first overlaps by 0.5."""

    split: str
    queries: int
    database: int
    mean_overlap: float
    top1_overlap_50: float
    top5_overlap_50: float
    top1_overlap_30: float
    oracle_mean_overlap: float
    oracle_top1_overlap_50: float
    random_mean_overlap: float
    recall_at_10_of_float: float


def psi_of(frames: list[Frame], signer: Signer) -> Floats:
    """(N, D) psi of the levels of the model's signature, before any rounding."""
    p, levels = signer.model.parameters, signer.model.levels
    found = []
    for f in tqdm(frames, desc="sign", unit="frame", disable=None):
        patches = describe(f, p).levels
        statistics = [table_statistics(patches[level], signer) for level in levels]
        found.append(float_signature(statistics, signer.model, f.name))
    return np.stack(found)


def unrounded(psi: Floats, model: Model) -> Floats:
    """(N, n) what stored signatures are rounded from: psi, or unit vectors."""
    own = model.whitening
    if own is None:
        return psi
    z = own.scales * (UNITS * psi @ own.basis.T.astype(float) - own.offsets)
    unit: Floats = z / np.linalg.norm(z, axis=1, keepdims=True)
    return unit


def stored(psi: Floats, model: Model) -> Bytes:
    """(N, n) signatures as a service stores them."""
    own, step = model.whitening, model.quantiser_step
    return np.stack([quantise(one, step) if own is None else whiten(one, own) for one in psi])


def ranks(rows: Floats) -> NDArray[np.intp]:
    """Database indices by rising distance, ties by index."""
    return np.argsort(rows, axis=1, kind="stable")


def recall_at_10(stored: Floats, exact: Floats) -> float:
    """Share of the exact first ten that stored signatures keep among their first ten."""
    kept = [
        len(set(a[:10]) & set(b[:10])) / 10
        for a, b in zip(ranks(stored), ranks(exact), strict=True)
    ]
    return float(np.mean(kept))


def measure(split: str, sequence: Sequence, signer: Signer, every: int = 1) -> Figures:
    """Figures of one split.

    Parameters
    ----------
    split : one of SPLITS
    sequence : redkitchen
    signer : see there
    every : take so many-th frame of both parts alone
    """
    database, queries = (
        [sequence.frames[i].read_depth() for i in part[::every]] for part in SPLITS[split]
    )
    model = signer.model
    d, q = psi_of(database, signer), psi_of(queries, signer)
    ranked = cross_distances(stored(q, model), stored(d, model), model.metric).astype(float)
    power = 1 if model.metric == "l1" else 2
    d_exact, q_exact = unrounded(d, model), unrounded(q, model)
    exact = np.stack([(np.abs(d_exact - one) ** power).sum(axis=1) for one in q_exact])
    truth = overlaps([view_of(f) for f in queries], [view_of(f) for f in database]).mean
    found = np.take_along_axis(truth, ranks(ranked), axis=1)
    best = truth.max(axis=1)
    return Figures(
        split=split,
        queries=len(queries),
        database=len(database),
        mean_overlap=float(found[:, 0].mean()),
        top1_overlap_50=float((found[:, 0] >= 0.5).mean()),
        top5_overlap_50=float((found[:, :5] >= 0.5).any(axis=1).mean()),
        top1_overlap_30=float((found[:, 0] >= 0.3).mean()),
        oracle_mean_overlap=float(best.mean()),
        oracle_top1_overlap_50=float((best >= 0.5).mean()),
        random_mean_overlap=float(truth.mean()),
        recall_at_10_of_float=recall_at_10(ranked, exact),
    )


def main() -> int:
    """Print a row per split, and JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path, help="folder of 7-Scenes redkitchen")
    parser.add_argument("--model", default="depth", help="preset or model file")
    parser.add_argument("--split", choices=SPLITS, action="append")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    sequence = find_sequences(options.scene)[0]
    signer = open_signer(options.model)
    rows = [measure(split, sequence, signer) for split in options.split or SPLITS]
    print(f"model {signer.model.label}")
    print("split    mean overlap  (oracle, random)  top-1 @.5  top-5 @.5  top-1 @.3  recall@10")
    for r in rows:
        print(
            f"{r.split:8} {r.mean_overlap:12.3f}  ({r.oracle_mean_overlap:.3f}, "
            f"{r.random_mean_overlap:.3f})    {r.top1_overlap_50:9.3f}  {r.top5_overlap_50:9.3f}"
            f"  {r.top1_overlap_30:9.3f}  {r.recall_at_10_of_float:9.3f}"
        )
    if options.json:
        options.json.write_text(
            json.dumps({"model": signer.model.id, "splits": [asdict(r) for r in rows]}, indent=1)
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
