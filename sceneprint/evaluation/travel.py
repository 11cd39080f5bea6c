"""How far a sensor had come between two frames of one run.

Member, ...  --travelled-->  metres of travel between each query and each database frame
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sceneprint.datasets.layouts import natural
from sceneprint.evaluation.records import Member
from sceneprint.types import Floats


def travelled(queries: Sequence[Member], database: Sequence[Member]) -> Floats:
    """Metres of path from each database frame to each query.

    The path leads through the frames of a run that take part, straight from each to the next:
    with every tenth frame alone it is a little shorter than it was.

    Parameters
    ----------
    queries, database : frames; those of one run have one name up to the last slash, and lie in
        the order of their names

    Returns
    -------
    (Q, N) metres; below 0 where the database frame is the later one, infinite for another run
    """
    along = {name: place for run in _runs((*queries, *database)) for name, place in run.items()}
    of_queries, of_database = ([_run(m) for m in members] for members in (queries, database))
    same = np.array(of_queries)[:, None] == np.array(of_database)
    there = np.array([along[m.name] for m in queries])
    here = np.array([along[m.name] for m in database])
    return np.where(same, there[:, None] - here, np.inf)


def _run(member: Member) -> str:
    return member.name.rpartition("/")[0]


def _runs(members: Sequence[Member]) -> list[dict[str, float]]:
    """Of each run, the place of each frame on its path, metres from the first."""
    runs: dict[str, dict[str, Member]] = {}
    for member in members:
        runs.setdefault(_run(member), {})[member.name] = member
    placed = []
    for frames in runs.values():
        names = sorted(frames, key=natural)
        positions = np.array([frames[name].pose[:3, 3] for name in names])
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        placed.append(dict(zip(names, np.concatenate([[0.0], np.cumsum(steps)]), strict=True)))
    return placed
