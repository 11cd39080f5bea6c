"""The pair table against the exact path: `python -m benchmarks.oracle FOLDER...` (minutes).

Twelve frames spread over the folders are signed both ways, with all their patches, and the
distances between them compared.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sceneprint.datasets import find_sequences
from sceneprint.signing import (
    describe,
    exact_statistics,
    float_signature,
    open_signer,
    table_statistics,
)
from sceneprint.types import Floats


def pairwise(rows: list[Floats]) -> Floats:
    """L1 distances of all pairs of rows, (N (N - 1) / 2,)."""
    return np.array([np.abs(a - b).sum() for i, a in enumerate(rows) for b in rows[:i]])


def main() -> int:
    """Print the correlation of the distances."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--model", default="paper", help="preset or model file")
    parser.add_argument("--frames", type=int, default=12)
    options = parser.parse_args()
    signer = open_signer(options.model)
    references = [r for f in options.folders for s in find_sequences(f) for r in s.frames]
    chosen = references[:: max(len(references) // options.frames, 1)][: options.frames]
    table, exact = [], []
    for reference in tqdm(chosen, desc="exact path", unit="frame", disable=None):
        levels = describe(reference.read(), signer.model.parameters).levels
        table.append(float_signature([table_statistics(x, signer) for x in levels], signer.model))
        exact.append(
            float_signature([exact_statistics(x, signer.model) for x in levels], signer.model)
        )
    correlation = np.corrcoef(pairwise(table), pairwise(exact))[0, 1]
    print(f"model {signer.model.label}: {len(chosen)} frames, correlation {correlation:.5f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
