"""Whole answers at places that look alike: `python -m benchmarks.lookalikes --seed S --sites N`.

seed  --synthesise_lookalike-->  sites  --answer_of-->  Told, ...  --table-->  shares by kind

Seeds 1 to 99 are for choosing numbers; judge by seeds from 1000 on that nobody has looked at.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sceneprint.errors import UselessFrame
from sceneprint.lab.evaluation.judgement import Candidate, Judge, QueryTask, answer_of, rank
from sceneprint.lab.evaluation.measures import answers
from sceneprint.lab.evaluation.protocol import (
    JudgedAnswer,
    SignedFrame,
    map_over,
    overlaps,
    view_of,
)
from sceneprint.lab.synth import synthesise_lookalike
from sceneprint.lab.synth.lookalikes import KINDS
from sceneprint.localization import PosePrior
from sceneprint.models import PRESETS, read_model
from sceneprint.pipeline import Signer, open_signer, prepare
from sceneprint.types import DepthFrame, Floats, Geometry
from sceneprint_client.poses import rotation_of

#: From this overlap, smaller direction, a frame of the map is enough to answer a query.
ANSWERABLE = 0.3
#: Queries of one site when absent scenes are asked by the thousand.
ABSENT_BLOCK = 100
#: Deviations that a robot gives with its prior, and how far that is turned at most, degrees.
PRIOR_M, PRIOR_DEG = 0.3, 10.0


@dataclass(frozen=True)
class Told:
    """What one query was told.

    Parameters
    ----------
    site, kind, query : where it was asked, and its number there
    answerable : whether a frame of the map overlaps it enough
    answer : see JudgedAnswer
    """

    site: str
    kind: str
    query: int
    answerable: bool
    answer: JudgedAnswer


def signed(
    frames: Sequence[DepthFrame], scene: str, signer: Signer, first: int
) -> tuple[list[DepthFrame], list[SignedFrame], list[Geometry]]:
    """Those frames that show anything, as an evaluation has them, and their geometry."""
    kept: list[DepthFrame] = []
    members: list[SignedFrame] = []
    geometries: list[Geometry] = []
    for frame in frames:
        try:
            signature, geometry = prepare(frame, signer)
        except UselessFrame:
            continue
        pose = np.eye(4) if frame.pose is None else frame.pose
        number = first + len(members)
        members.append(SignedFrame(number, frame.name, scene, pose, signature.vector))
        geometries.append(geometry)
        kept.append(frame)
    return kept, members, geometries


def prior_about(
    pose: Floats, parent: str, least: float, most: float, rng: np.random.Generator
) -> PosePrior:
    """What a robot believes that is off by `least` to `most` metres, any way, and up to 10 degrees.

    It says of itself 30 cm and 10 degrees, whatever it is.
    """
    directions = rng.standard_normal((2, 3))
    shift, axis = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    T = np.eye(4)
    half = np.deg2rad(rng.uniform(0.0, PRIOR_DEG)) / 2
    T[:3, :3] = rotation_of(np.array([*(np.sin(half) * axis), np.cos(half)])) @ pose[:3, :3]
    T[:3, 3] = pose[:3, 3] + shift * rng.uniform(least, most)
    told = [PRIOR_M] * 3 + [np.deg2rad(PRIOR_DEG)] * 3
    return PosePrior(parent, T, np.diag(np.square(told)))


def ask_site(
    signer: Signer,
    work: tuple[str, int, int],
    *,
    seed: int,
    candidates: int = 10,
    prior: tuple[float, float] | None = None,
) -> list[Told]:
    """Build one site and ask all its queries.

    Parameters
    ----------
    work : kind, index and number of queries
    seed : of the collection
    candidates : size of C
    prior : least and most metres that the robot's belief is off; None: it has none
    """
    kind, index, queries = work
    rng = np.random.default_rng([seed, index, KINDS.index(kind)])
    site = synthesise_lookalike(kind, seed, index, queries=queries)
    shown, database, of_map = signed(site.map, site.name, signer, 0)
    # of another place: a pose in its own frame is a pose in no map
    scene = site.name if site.same_frame else f"{site.name}, elsewhere"
    sent, asked, of_queries = signed(site.queries, scene, signer, len(database))
    geometries = [*of_map, *of_queries]
    p = signer.model.parameters.validation
    judge = Judge(geometries.__getitem__, "full", 0, p, database=database)
    ranked = rank(
        np.stack([q.signature for q in asked]), np.stack([d.signature for d in database]),
        np.ones((len(asked), len(database)), np.bool_), metric=signer.model.metric,
        candidates=candidates,
    )  # fmt: skip
    able = _answerable(shown, sent) if site.present else [False] * len(sent)
    told = []
    for number, (query, one) in enumerate(zip(asked, ranked, strict=True)):
        among = tuple(
            Candidate(j, j, database[j].scene, database[j].pose, 0.0, 0.0) for j in one.selection
        )
        rows = np.arange(len(database))
        task = QueryTask(
            query.number, scene, query.pose, [], one.selection, among, rows, one.retrieved
        )  # fmt: skip
        believed = None if prior is None else prior_about(query.pose, site.name, *prior, rng)
        told.append(Told(site.name, kind, number, able[number], answer_of(judge, task, believed)))
    return told


def _answerable(shown: Sequence[DepthFrame], sent: Sequence[DepthFrame]) -> list[bool]:
    seen = overlaps([view_of(q) for q in sent], [view_of(d) for d in shown])
    return [bool(most >= ANSWERABLE) for most in seen.least.max(axis=1)]


def table(told: Sequence[Told]) -> list[str]:
    """Shares by kind as lines of Markdown, and over all."""
    lines = [
        "| kind | queries | answerable | found and right | found and wrong "
        "| beyond 50 cm or 15 deg | at most | called strong | ambiguous | not found | ms |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    kinds = [k for k in KINDS if any(one.kind == k for one in told)]
    for name, own in [*((k, [t for t in told if t.kind == k]) for k in kinds), ("all", list(told))]:
        f = answers([one.answer for one in own])
        keys = (
            "found_right", "found_wrong", "grossly_wrong", "grossly_wrong_at_most",
            "found_strong_wrong", "ambiguous", "not_found",
        )  # fmt: skip
        shares = " | ".join(f"{f[key] or 0.0:.3f}" for key in keys)
        able = sum(one.answerable for one in own)
        ms = float(np.median([one.answer.milliseconds for one in own]))
        lines.append(f"| {name} | {len(own)} | {able} | {shares} | {ms:.0f} |")
    return lines


def main() -> None:
    """Ask the sites and print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.lookalikes", description=__doc__)
    parser.add_argument("--seed", type=int, default=1, help="of the sites (default: 1)")
    parser.add_argument("--sites", type=int, default=3, help="of each kind (default: 3)")
    parser.add_argument("--first", type=int, default=0, help="index of the first (default: 0)")
    parser.add_argument("--queries", type=int, default=16, help="of each site (default: 16)")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument(
        "--absent", type=int, default=0, metavar="N", help="queries of other places"
    )
    parser.add_argument(
        "--prior", nargs=2, type=float, metavar=("LEAST", "MOST"),
        help="metres that the robot's prior is off, as 0 0.3 or 1.5 4 (default: it has none)",
    )  # fmt: skip
    parser.add_argument("--candidates", type=int, default=10, help="size of C (default: 10)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default: 1)")
    parser.add_argument("--model", default=PRESETS[0])
    parser.add_argument("--json", type=Path, help="write every answer to this file")
    options = parser.parse_args()
    work = [
        (kind, index, options.queries)
        for index in range(options.first, options.first + options.sites)
        for kind in options.kinds
    ]
    if options.absent:
        blocks = range(-(-options.absent // ABSENT_BLOCK))
        work = [
            ("absent", options.first + b, min(ABSENT_BLOCK, options.absent - b * ABSENT_BLOCK))
            for b in blocks
        ]
    start, told = time.monotonic(), []
    prior = None if options.prior is None else (options.prior[0], options.prior[1])
    do = partial(ask_site, seed=options.seed, candidates=options.candidates, prior=prior)
    opening = partial(_open, options.model)
    for of_site in tqdm(map_over(work, do, opening, options.jobs), total=len(work), disable=None):
        told += of_site
    print("\n".join(table(told)))
    print(f"seed {options.seed}, {len(work)} sites, {time.monotonic() - start:.0f} s")
    if options.json is not None:
        options.json.write_text(json.dumps([asdict(one) for one in told], indent=1))


def _open(model: str) -> Signer:
    return open_signer(read_model(model))


if __name__ == "__main__":
    main()
