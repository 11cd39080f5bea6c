"""LiDAR: places found again after 30 m of travel, and what validation says of them.

`python -m benchmarks.lidar HALL` reports on the recorded hall (`../shared/data/lidar/hall`);
`python -m benchmarks.lidar --sites N` on walks through N synthetic sites that no model was
trained on, which is what the preset `lidar` was tuned by.

A scan's database are all scans taken more than 30 m of travel before it (`earlier`), or before
or after it (`any`). Counted are the scans to which that database holds one within 5 m: whether
the nearest in signature is such a one.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.lidar_answers import first_answers
from benchmarks.lidar_pairs import believed, candidates, confirmed, pairs_within, pose_of
from sceneprint.evaluation.baselines.rings import ring_descriptor, ring_distances
from sceneprint.geometry.retrieval import distances
from sceneprint.pipeline import Signature, prepare, validate
from sceneprint.scans import decode_cloud
from sceneprint.signing import Signer, open_signer
from sceneprint.synth.surveys import synthesise_survey
from sceneprint.types import Cloud, Floats

GAP_M, WITHIN_M = 30.0, 5.0  #: of travel between query and database; of a right answer
CANDIDATES = 3  #: of a query, validated in order
MOST_PAIRS = 150  #: of a kind, spread over all there are
HELD_OUT = 2000  #: seed of synthetic sites to measure on; training has 0, tuning had 1000
WALK = 60  #: scans of a synthetic walk


@dataclass(frozen=True)
class Found:
    """Of queries that have a right answer, those whose nearest is one."""

    queries: int
    ours: int
    ring: int


def read_walk(folder: Path) -> list[Cloud]:
    """The scans of a recording with their poses, in order."""
    return [
        decode_cloud(
            path.read_bytes(),
            name=path.stem,
            pose=np.loadtxt(path.with_suffix(".pose.txt")),
        )
        for path in sorted(folder.glob("*.pcd"))
    ]


def positions(walk: Sequence[Cloud]) -> Floats:
    """(n, 3) metres."""
    return np.stack([pose_of(cloud)[:3, 3] for cloud in walk])


def apart(at: Floats, *, both_ways: bool) -> NDArray[np.bool_]:
    """(n, n) whether the second lies more than GAP_M of travel before (or after) the first."""
    along = np.append(0.0, np.linalg.norm(np.diff(at, axis=0), axis=1).cumsum())
    since = along[:, None] - along[None, :]
    return np.asarray((np.abs(since) if both_ways else since) > GAP_M)


def first_right(rows: Floats, at: Floats, allowed: NDArray[np.bool_]) -> tuple[int, int]:
    """Queries that have a right answer, and those whose nearest by `rows` (n, n) is one."""
    near = np.linalg.norm(at[:, None] - at[None, :], axis=2) < WITHIN_M
    asked = (near & allowed).any(axis=1)
    nearest = np.where(allowed, rows, np.inf).argmin(axis=1)
    right = near[np.arange(len(at)), nearest]
    return int(asked.sum()), int((asked & right).sum())


def signature_rows(signatures: Sequence[Signature]) -> Floats:
    """(n, n) distances of signatures."""
    stored = np.stack([one.vector for one in signatures])
    return np.stack([distances(one, stored, signatures[0].metric) for one in stored]).astype(float)


def ring_rows(walk: Sequence[Cloud]) -> Floats:
    """(n, n) distances of ring descriptors."""
    stored = np.stack([ring_descriptor(cloud.points) for cloud in walk])
    return np.stack([ring_distances(one, stored) for one in stored]).astype(float)


def timed(run: Callable[[], object], times: int = 5) -> float:
    """Median milliseconds of a call, of one thread's work: others on the machine do not count."""
    run()  # what is compiled, or built once, is not what a query costs
    took = []
    for _ in range(times):
        start = time.thread_time()
        run()
        took.append(1000 * (time.thread_time() - start))
    return float(np.median(took))


def synthetic_walks(n: int) -> list[list[Cloud]]:
    """Walks through `n` sites that training does not know."""
    return [
        list(synthesise_survey(HELD_OUT, index, WALK, along_path=True).clouds) for index in range(n)
    ]


def measure(walk: Sequence[Cloud], signer: Signer, *, pairs: bool) -> dict[str, object]:
    """All figures of one walk."""
    at = positions(walk)
    made = [prepare(cloud, signer) for cloud in tqdm(walk, desc="sign", disable=None)]
    rows, rings = signature_rows([s for s, _ in made]), ring_rows(walk)
    result: dict[str, object] = {"scans": len(walk)}
    for name, both_ways in (("earlier", False), ("any", True)):
        allowed = apart(at, both_ways=both_ways)
        queries, ours = first_right(rows, at, allowed)
        result[name] = asdict(Found(queries, ours, first_right(rings, at, allowed)[1]))
    if pairs:
        geometries = [g for _, g in made]
        p = signer.model.parameters.validation
        near = np.linalg.norm(at[:, None] - at[None, :], axis=2) < WITHIN_M

        for name, both_ways in (("earlier", False), ("any", True)):
            allowed = apart(at, both_ways=both_ways)
            answered = first_answers(geometries, rows, near, allowed, p, partial(confirmed, walk))
            result[f"first match, {name}"] = asdict(answered)
        allowed = apart(at, both_ways=True)
        everything = np.ones((len(at), len(at)), bool)
        lists = {
            "candidates": candidates(rows, allowed, CANDIDATES),
            "within 10 m, after 30 m": pairs_within(at, allowed),
            "within 10 m": pairs_within(at, everything),
        }
        for name, chosen in lists.items():
            spread = np.linspace(0, len(chosen) - 1, min(len(chosen), MOST_PAIRS)).astype(int)
            figures, each = believed(walk, geometries, [chosen[k] for k in spread], p)
            result[name] = {**asdict(figures), "each": each}
    return result


def milliseconds(walk: Sequence[Cloud], signer: Signer) -> dict[str, float]:
    """What one query costs on this thread: signing, searching the walk, validating one."""
    cloud = walk[-1]
    stored = [prepare(one, signer) for one in walk[:20]]
    vectors = np.stack([one.vector for one, _ in stored])
    signature, geometry = prepare(cloud, signer)
    p = signer.model.parameters.validation
    return {
        "points": float(len(cloud.points)),
        "prepare": timed(lambda: prepare(cloud, signer)),
        "search": timed(lambda: distances(signature.vector, vectors, signature.metric)),
        "validate": timed(lambda: validate(geometry, stored[0][1], p=p)),
    }


def negatives(walk: Sequence[Cloud], signer: Signer, n: int) -> dict[str, int]:
    """Scans against scans of `n` synthetic sites each: how many pairs are believed."""
    ours = [prepare(cloud, signer)[1] for cloud in walk[:: max(1, len(walk) // 20)]]
    accepted, pairs, p = 0, 0, signer.model.parameters.validation
    for index in tqdm(range(n), desc="negatives", disable=None):
        kind = ("hall", "storey")[index % 2]
        for cloud in synthesise_survey(HELD_OUT + 1, index, 2, kind=kind).clouds:
            other = prepare(cloud, signer)[1]
            for one in ours:
                pairs += 1
                accepted += validate(one, other, p=p).status == "accepted"
    return {"pairs": pairs, "accepted": accepted}


def main() -> int:
    """Print the figures, and write them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("hall", type=Path, nargs="?", help="folder of lidar/hall")
    parser.add_argument("--sites", type=int, default=0, metavar="N", help="synthetic sites")
    parser.add_argument("--model", default="lidar", help="preset or model file")
    parser.add_argument("--pairs", action="store_true", help="validate, too")
    parser.add_argument("--negatives", type=int, default=0, metavar="N", help="synthetic sites")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    signer = open_signer(options.model)
    walks = {f"site {k}": walk for k, walk in enumerate(synthetic_walks(options.sites))}
    if options.hall:
        walks[options.hall.name] = read_walk(options.hall)
    report: dict[str, object] = {"model": signer.model.id}
    for name, walk in walks.items():
        report[name] = figures = measure(walk, signer, pairs=options.pairs)
        print(name, {k: _short(v) for k, v in figures.items()}, flush=True)
    last = list(walks.values())[-1]
    report["milliseconds"] = milliseconds(last, signer)
    print("milliseconds", report["milliseconds"])
    if options.negatives:
        report["negatives"] = negatives(last, signer, options.negatives)
        print("negatives", report["negatives"])
    if options.json:
        options.json.write_text(json.dumps(report, indent=1))
    return 0


def _short(value: object) -> object:
    return {k: v for k, v in value.items() if k != "each"} if isinstance(value, dict) else value


if __name__ == "__main__":
    sys.exit(main())
