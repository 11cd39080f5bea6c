"""What is stored, and how it is compared: `python -m benchmarks.choices DATA_ROOT`.

Retrieval alone, of stored bytes; levels are prefixes of them. The paper's choice stands unless
another is better somewhere and worse nowhere, by a bootstrap over blocks of consecutive queries.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from sceneprint.evaluation.overlap import AnyView, overlap, view_of
from sceneprint.evaluation.protocol import choose, parse_part
from sceneprint.geometry.retrieval import Ints64, Metric, cross_distances
from sceneprint.pipeline import Signer, open_signer, sign
from sceneprint.synth import KINECT, take, trajectory
from sceneprint.synth.synthesis import room_and_rng
from sceneprint.types import Bytes, Floats, Frame

FORWARD = "7scenes/redkitchen@db=0:600:2,queries=650:1000:2"
REVERSE = "7scenes/redkitchen@db=400:1000:3,queries=0:350:3"
DESK, STUDY = "tum/fr1_rpy@db=0:217", "sun3d/studyroom2@db=0:25+50:75"
#: Trials that decide, and those looked at after the decision.
DECIDING = {
    "reverse": [REVERSE],
    "combined": [FORWARD, f"{DESK},queries=235:", f"{STUDY},queries=30:50"],
    "synthetic": [],  # rooms made here
}
CONTROLS = {"forward": [FORWARD], "combined, reverse": [REVERSE, DESK, STUDY]}
ONE, SEVERAL = ("mean overlap", "overlap >= 0.5"), ("right scene", "mean overlap")  #: by scenes
#: Frames of a room's path, every which is taken; a query may find what overlaps it by less.
PATH, STEP, HIGHEST_OVERLAP = 240, 6, 0.8
#: Consecutive queries in a block of the bootstrap, and how often blocks are drawn.
BLOCK, DRAWS = 10, 10_000


@dataclass(frozen=True)
class Choice:
    """So many patches of the finest level, a metric, so many levels."""

    patches: int
    metric: Metric
    levels: int


PATCHES, LEVELS = (1000, 500), (4, 3, 2, 1)
PAPER = Choice(1000, "l1", 4)
CHOICES = [Choice(p, m, h) for p, m, h in product(PATCHES, get_args(Metric), LEVELS)]


@dataclass(frozen=True)
class Figure:
    """A mean, and its difference from the paper's with the ends of the 95 % interval."""

    value: float
    difference: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Trial:
    """Stored signatures by patches; (Q,) scenes of queries; (Q, N) truth, allowed."""

    queries: dict[int, Bytes]
    database: dict[int, Bytes]
    scenes: list[str]
    same: NDArray[np.bool_]
    overlap: Floats
    allowed: NDArray[np.bool_]


Shots = Iterator[tuple[str, bool, Frame]]  #: scene, whether a query, frame
Known = dict[str, dict[int, Bytes]]  #: signatures by name and patches
Table = dict[Choice, dict[str, Figure]]


def recordings(root: Path, name: str, parts: list[str]) -> Shots:
    """Frames of a protocol."""
    chosen = choose([parse_part(str(root / part)) for part in parts]).frames
    for one in tqdm(chosen, desc=name, unit="frame", disable=None):
        yield one.scene, one.use == "query", replace(one.reference.read_depth(), name=one.name)


def rooms(seed: int, count: int) -> Shots:
    """Views along a path through each room, in turn of the database and queries."""
    for number in tqdm(range(count), desc="synthetic", unit="room", disable=None):
        room, rng = room_and_rng(seed, number)
        for i, pose in enumerate(trajectory(room, PATH, rng)[::STEP]):
            frame = Frame(take(room, pose, KINECT, rng), KINECT, f"room-{number}/{i}", pose)
            yield f"room-{number}", i % 2 == 1, frame


def prepare(shots: Shots, signers: dict[int, Signer], known: Known, highest: float) -> Trial:
    """Sign what is not `known` yet, and allow what overlaps by less than `highest`."""
    frames: tuple[list[tuple[str, str, AnyView]], ...] = ([], [])
    for scene, is_query, frame in shots:
        if frame.name not in known:
            known[frame.name] = {n: sign(frame, signer).vector for n, signer in signers.items()}
        frames[is_query].append((scene, frame.name, view_of(frame)))
    d, q = ({n: np.stack([known[one[1]][n] for one in use]) for n in signers} for use in frames)
    same = np.array([[a[0] == b[0] for b in frames[0]] for a in frames[1]])
    shared = np.zeros(same.shape)
    for i, j in np.argwhere(same):
        shared[i, j] = overlap(frames[1][i][2], frames[0][j][2])[0]
    return Trial(q, d, [one[0] for one in frames[1]], same, shared, shared < highest)


def by_levels(queries: Bytes, database: Bytes, metric: Metric, of: int) -> list[Ints64]:
    """Distances (Q, N) by the first level, by the first two, and so on to all `of` them."""
    parts = zip(np.split(queries, of, axis=1), np.split(database, of, axis=1), strict=True)
    return list(np.cumsum([cross_distances(q, d, metric) for q, d in parts], axis=0))


def compare(values: Floats, paper: Floats, scenes: list[str]) -> Figure:
    """Compare figures of queries with the paper's, over blocks of one scene drawn anew."""
    change = values - paper
    index = [np.flatnonzero(np.array(scenes) == scene) for scene in dict.fromkeys(scenes)]
    blocks = [own[i : i + BLOCK] for own in index for i in range(0, len(own), BLOCK)]
    sums, sizes = np.array([(change[block].sum(), len(block)) for block in blocks]).T
    drawn = np.random.default_rng(0).integers(0, len(blocks), (DRAWS, len(blocks)))
    means = sums[drawn].sum(axis=1) / sizes[drawn].sum(axis=1)
    low, high = np.quantile(means, (0.025, 0.975)).round(9)  # no sign from a rounding
    return Figure(float(values.mean()), float(change.mean()), float(low), float(high))


def measure(trial: Trial, name: str, figures: tuple[str, ...]) -> Table:
    """Figures of every choice; of equal distances the first frame is the nearest."""
    found = {}
    for patches, metric in product(PATCHES, get_args(Metric)):
        stored = trial.queries[patches], trial.database[patches]
        for h, rows in enumerate(by_levels(*stored, metric, max(LEVELS)), 1):
            hidden = np.where(trial.allowed, rows, np.iinfo(np.int64).max)
            first = np.arange(len(rows)), hidden.argmin(axis=1)
            shared, right = trial.overlap[first], 1.0 * trial.same[first]
            kinds = shared, 1.0 * (shared >= 0.5), right
            found[Choice(patches, metric, h)] = dict(zip((*ONE, SEVERAL[0]), kinds, strict=True))
    return {
        c: {f"{name}: {f}": compare(found[c][f], found[PAPER][f], trial.scenes) for f in figures}
        for c in CHOICES
    }


def decide(table: Mapping[Choice, Mapping[str, Figure]]) -> Choice:
    """Return the choice better on most figures and worse on none, else the paper's."""
    rows = {c: row.values() for c, row in table.items() if all(f.high >= 0 for f in row.values())}
    return max([PAPER, *rows], key=lambda c: sum(f.low > 0 for f in rows.get(c, ())))


def show(table: Table) -> None:
    """Print means and intervals as Markdown."""
    print(f"\n| patches | metric | levels | {' | '.join(table[PAPER])} |")
    print("|--:|---|--:|" + "--:|" * len(table[PAPER]))
    for c, row in table.items():
        cells = [f"{f.value:.3f} [{f.low:+.3f}, {f.high:+.3f}]" for f in row.values()]
        print(f"| {c.patches} | {c.metric.upper()} | {c.levels} | {' | '.join(cells)} |")


def main() -> None:
    """Print figures, decision and controls as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", type=Path, metavar="DATA_ROOT")
    parser.add_argument("--seed", type=int, default=901, help="of synthetic rooms, not a model's")
    parser.add_argument("--rooms", type=int, default=16, help="how many of them")
    parser.add_argument("--json", type=Path)
    o = parser.parse_args()
    signer, known, signers = open_signer("depth"), Known(), dict[int, Signer]()
    model, segmentation = signer.model, signer.model.parameters.segmentation
    for n in PATCHES:  # one mixture, and so one pair table, serves all
        p = replace(model.parameters, segmentation=replace(segmentation, n_patches=n))
        signers[n] = Signer(replace(model, parameters=p), signer.table)
    tables: list[Table] = []
    for trials in (DECIDING, CONTROLS):
        tables.append({c: {} for c in CHOICES})
        for name, parts in trials.items():
            shots = recordings(o.root, name, parts) if parts else rooms(o.seed, o.rooms)
            trial = prepare(shots, signers, known, np.inf if parts else HIGHEST_OVERLAP)
            best = np.where(trial.allowed, trial.overlap, 0).max(axis=1).mean()
            print(f"{name}: queries x database {trial.same.shape}, best overlap {best:.3f}")
            rows = measure(trial, name, ONE if trial.same.all() else SEVERAL)
            tables[-1] = {c: tables[-1][c] | rows[c] for c in CHOICES}
        show(tables[-1])
        print("" if tables[1:] else f"\ndecision: {decide(tables[0])}\n")
    if o.json:
        plain = [asdict(c) | {k: asdict(t[c][k]) for t in tables for k in t[c]} for c in CHOICES]
        found = {"model": model.id, "seed": o.seed, "rooms": o.rooms, "rows": plain}
        o.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
