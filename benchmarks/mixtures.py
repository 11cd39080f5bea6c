"""What the mixture was learnt from, and its size: `python -m benchmarks.mixtures DATA_ROOT`.

The paper's figure on consistency (Fig. `ablations`): models alike in all but the frames that
projection and mixture were learnt from, and then but the number of components; by retrieval alone.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.choices import DECIDING, recordings
from sceneprint.datasets import FrameReference
from sceneprint.evaluation.overlap import AnyView, overlap, view_of
from sceneprint.evaluation.protocol import choose, parse_part
from sceneprint.geometry.retrieval import cross_distances
from sceneprint.recipes import preset_parameters
from sceneprint.signing import Signer, describe, encode, open_signer
from sceneprint.training import TrainingParameters, train
from sceneprint.types import Bytes, Floats

#: About a hundred frames each, of the database of a part; a recording's are of one of the rooms
#: that the figures are of.
SOURCES = {
    "synthetic rooms": None,
    "redkitchen": "7scenes/redkitchen@db=0:600:6,queries=999:",
    "studyroom2": "sun3d/studyroom2@db=0:99,queries=99:",
    "fr1_rpy": "tum/fr1_rpy@db=0:217:2,queries=297:",
}
ROOMS = 17
#: Components of the models that are compared by source, and sizes compared on synthetic rooms.
COMPONENTS = 256
SIZES = (32, 64, 128, 256, 512, 1250)
TRIALS = {name: DECIDING[name] for name in ("reverse", "combined")}


@dataclass(frozen=True)
class Learnt:
    """What a model was learnt from, with how many components."""

    source: str
    components: int


WANTED = [
    *(Learnt(source, COMPONENTS) for source in SOURCES),
    *(Learnt("synthetic rooms", g) for g in SIZES if g != COMPONENTS),
]


def learn(root: Path, wanted: Learnt, jobs: int, rooms: int = ROOMS) -> Signer:
    """Train the model, with all but G and its frames as `paper` has it."""
    part = SOURCES[wanted.source]
    chosen = [] if part is None else choose([parse_part(str(root / part))]).frames
    own = [one for one in chosen if one.use == "database"]
    # training asks for two places, of whose distance nothing here makes use
    frames: list[tuple[str, FrameReference]] = [
        (f"half {i * 2 // len(own)}", one.reference) for i, one in enumerate(own)
    ]
    model_p, mixture_p = preset_parameters("paper")
    model = train(
        "learnt",
        model_p,
        replace(mixture_p, n_components=wanted.components),
        TrainingParameters(rooms=rooms if part is None else 0),
        frames,
        jobs,
    )
    return open_signer(model, cached=False)


@dataclass(frozen=True, eq=False)
class Trial:
    """Signatures by model, (Q, D) and (N, D); (Q, N) of one scene, and overlap."""

    queries: dict[Learnt, Bytes]
    database: dict[Learnt, Bytes]
    same: NDArray[np.bool_]
    overlap: Floats


@dataclass(frozen=True, eq=False)
class Row:
    """A frame of a trial."""

    scene: str
    is_query: bool
    view: AnyView
    signatures: dict[Learnt, Bytes]


def signed(root: Path, name: str, signers: dict[Learnt, Signer]) -> Iterator[Row]:
    """Every frame of a trial, segmented once and encoded by each model."""
    p = next(iter(signers.values())).model.parameters
    for scene, is_query, frame in recordings(root, name, TRIALS[name]):
        patches = describe(frame, p)
        vectors = {one: encode(patches, signer).vector for one, signer in signers.items()}
        yield Row(scene, is_query, view_of(frame), vectors)


def trial_of(rows: list[Row]) -> Trial:
    """The trial that these frames make."""
    asked, kept = ([one for one in rows if one.is_query is use] for use in (True, False))
    same = np.array([[a.scene == b.scene for b in kept] for a in asked])
    shared = np.zeros(same.shape)
    for i, j in np.argwhere(same):
        shared[i, j] = overlap(asked[i].view, kept[j].view)[0]
    q, d = (
        {one: np.stack([row.signatures[one] for row in use]) for one in use[0].signatures}
        for use in (asked, kept)
    )
    return Trial(q, d, same, shared)


def figures(trial: Trial) -> dict[Learnt, dict[str, float]]:
    """Of the nearest frame by each model: its overlap with the query, and of the right scene."""
    found = {}
    for one, queries in trial.queries.items():
        rows = cross_distances(queries, trial.database[one], "l1")
        first = np.arange(len(rows)), rows.argmin(axis=1)
        shared = trial.overlap[first]
        found[one] = {
            "right scene": float(trial.same[first].mean()),
            "mean overlap": float(shared.mean()),
            "overlap >= 0.5": float((shared >= 0.5).mean()),
        }
    return found


def show(found: dict[str, dict[Learnt, dict[str, float]]]) -> None:
    """Print the figures as Markdown."""
    names = [f"{name}: {f}" for name, rows in found.items() for f in next(iter(rows.values()))]
    print(f"\n| learnt from | G | {' | '.join(names)} |")
    print("|---|--:|" + "--:|" * len(names))
    for one in WANTED:
        cells = [f"{value:.3f}" for rows in found.values() for value in rows[one].values()]
        print(f"| {one.source} | {one.components} | {' | '.join(cells)} |")


def main() -> None:
    """Train, sign, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", type=Path, metavar="DATA_ROOT")
    parser.add_argument("--jobs", type=int, default=1, help="processes that segment for training")
    parser.add_argument("--json", type=Path)
    o = parser.parse_args()
    learnt = partial(learn, o.root, jobs=o.jobs)
    bar = tqdm(WANTED, desc="training", unit="model", disable=None)
    signers = {one: learnt(one) for one in bar}
    found = {}
    for name in TRIALS:
        trial = trial_of(list(signed(o.root, name, signers)))
        best = trial.overlap.max(axis=1).mean()
        print(f"{name}: queries x database {trial.same.shape}, best overlap {best:.3f}")
        found[name] = figures(trial)
    show(found)
    if o.json:
        told = [
            {"source": one.source, "components": one.components}
            | {name: rows[one] for name, rows in found.items()}
            for one in WANTED
        ]
        o.json.write_text(json.dumps(told, indent=1))


if __name__ == "__main__":
    main()
