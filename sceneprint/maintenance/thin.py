"""Thinning a map out: which frames it can lose, and what their loss would mean.

map  --propose-->  Proposal  --carry_out-->  frames deleted

Two ways to choose. By novelty: in the order they came, a frame stays if no frame that stays is as
near as the limit. By number: the k-DPP of Sec. III-D keeps the frames that together say most.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import InvalidRequest, NotFound
from sceneprint.geometry.retrieval.ranking import (
    cross_distances,
    distance_share,
    distances,
    novel,
    pairwise_distances,
    share_distance,
    summarise,
)
from sceneprint.index import signatures_of
from sceneprint.index.generation_files import Keys
from sceneprint.store.frame_queries import Weight, weights_of
from sceneprint.types import Bytes
from sceneprint_client.api import FrameState

if TYPE_CHECKING:
    from sceneprint.engine import Engine
    from sceneprint.engine.search.local_index import IndexView

#: Memory that the choice of a number of frames may take: 8 bytes for each kept one and each frame.
CHOICE_BYTES = 2 << 30
#: Frames whose distances among each other give the k-DPP its scale.
SAMPLE = 256
#: New frames, and kept ones, that are compared at once.
BLOCK, KEPT_BLOCK = 256, 1024

#: Called with the number of steps done and their total.
Progress = Callable[[int, int], None]
Ints64 = NDArray[np.int64]


@dataclass(frozen=True)
class Loss:
    """A frame that can go.

    Parameters
    ----------
    frame_id : of the frame
    like : the frame that stays in its place
    share : their distance, as a share of that of unrelated frames
    """

    frame_id: str
    like: str
    share: float


@dataclass(frozen=True)
class Proposal:
    """What a map can lose.

    Parameters
    ----------
    map : its name
    model : label of its model
    n_frames : that were looked at
    losses : in the order they came
    freed_bytes : of uploads, artifacts and signatures; less where maps share an upload
    """

    map: str
    model: str
    n_frames: int
    losses: tuple[Loss, ...]
    freed_bytes: int

    @property
    def shares(self) -> tuple[float, float]:
        """Median and largest share of the losses; 0 where there are none."""
        found = [one.share for one in self.losses] or [0.0]
        return float(np.median(found)), max(found)


def propose(
    engine: Engine, map_name: str, *, keep: int | None = None, novelty: float | None = None,
    session: str | None = None, seed: int = 0, progress: Progress | None = None,
) -> Proposal:  # fmt: skip
    """Say which frames of a map can go; nothing is changed.

    Parameters
    ----------
    engine : see Engine
    map_name : of the map
    keep : how many frames shall stay, or
    novelty : the share of the distance of unrelated frames within which a frame repeats another
    session : only frames of this session are looked at, as if they were all there is
    seed : of the frames that give `keep` its scale
    progress : told of the steps

    Raises
    ------
    UnknownMap : no such map.
    InvalidRequest : neither or both ways, or a choice that would take too much memory.
    """
    if (keep is None) == (novelty is None):
        raise InvalidRequest("Give the number of frames to keep, or a novelty, and not both.")
    row, model, view = engine.view(map_name)
    with engine.store.database.read() as connection:
        weights = weights_of(connection, row, session)
    stored = np.concatenate([view.tail.keys, *([view.generation.keys] if view.generation else [])])
    known = np.fromiter(weights, np.int64, len(weights))
    keys = np.setdiff1d(np.intersect1d(known, stored), np.array(sorted(view.dead), np.int64))
    tell = progress or _silent
    d0 = model.unrelated_distance
    if keep is not None:
        nearest, to_nearest = _nearest_kept(view, keys, keep, seed, tell)
    else:
        assert novelty is not None
        limit = share_distance(novelty, d0, model.metric)
        nearest, to_nearest = _first_of_each(view, keys, limit, tell)
    lost = np.flatnonzero(nearest != np.arange(len(keys)))
    names = [weights[int(key)] for key in keys]
    shares = distance_share(to_nearest, d0, model.metric)
    losses = [Loss(names[i].frame_id, names[nearest[i]].frame_id, float(shares[i])) for i in lost]
    freed = sum(_bytes(engine, names[i]) + model.signature_bytes for i in lost)
    return Proposal(row.name, model.label, len(keys), tuple(losses), freed)


def carry_out(engine: Engine, proposal: Proposal, progress: Progress | None = None) -> int:
    """Delete what can go, each frame effective at once.

    Returns
    -------
    deleted : how many; the others were gone already, or what stood for them is
    """
    deleted = 0
    for done, one in enumerate(proposal.losses, 1):
        try:
            if engine.get_frame(proposal.map, one.like).state == FrameState.INDEXED:
                engine.delete_frame(proposal.map, one.frame_id)
                deleted += 1
        except NotFound:
            pass  # somebody was first
        if progress is not None:
            progress(done, len(proposal.losses))
    return deleted


def _nearest_kept(
    view: IndexView, keys: Keys, keep: int, seed: int, progress: Progress
) -> tuple[Ints64, Ints64]:
    """For each frame the nearest of those that stay, and its distance."""
    n = len(keys)
    if keep >= n:
        return np.arange(n), np.zeros(n, np.int64)
    if keep * n * 8 > CHOICE_BYTES:
        raise InvalidRequest(
            f"Choosing {keep} of {n} frames would take {keep * n * 8 / 2**30:.1f} GiB of memory, "
            f"and {CHOICE_BYTES / 2**30:.0f} GiB are allowed. Keep fewer, thin out one session "
            "after the other with --session, or use --novelty, which takes little."
        )
    rng = np.random.default_rng(seed)
    drawn = np.sort(rng.choice(n, min(SAMPLE, n), replace=False))
    among = pairwise_distances(_rows(view, keys[drawn]), view.metric)
    sigma = float(np.median(among[np.triu_indices(len(drawn), 1)]))
    asked = 0

    def distances_of(index: int) -> Ints64:
        nonlocal asked
        asked += 1
        progress(asked, keep)
        return _distances_to_all(view, keys, index)

    summary = summarise(distances_of, n, keep, sigma)
    return summary.nearest.astype(np.int64), summary.distances.astype(np.int64)


def _first_of_each(
    view: IndexView, keys: Keys, limit: float, progress: Progress
) -> tuple[Ints64, Ints64]:
    """For each frame the nearest of those that stay and came before it, and its distance."""
    n, far = len(keys), np.iinfo(np.int64).max
    nearest, to_nearest = np.full(n, -1, np.int64), np.full(n, far)
    kept: list[int] = []
    for start in range(0, n, BLOCK):
        new = np.arange(start, min(start + BLOCK, n))
        rows = _rows(view, keys[new])
        for low in range(0, len(kept), KEPT_BLOCK):
            some = np.array(kept[low : low + KEPT_BLOCK])
            found = cross_distances(rows, _rows(view, keys[some]), view.metric)
            best = np.argmin(found, axis=1)
            least = found[np.arange(len(new)), best]
            nearer = least < to_nearest[new]
            nearest[new[nearer]], to_nearest[new[nearer]] = some[best[nearer]], least[nearer]
        among = pairwise_distances(rows, view.metric)
        stays, within = novel(to_nearest[new], among, limit)
        inside = np.flatnonzero(within >= 0)
        nearest[new[inside]] = new[within[inside]]
        to_nearest[new[inside]] = among[inside, within[inside]]
        nearest[new[stays]], to_nearest[new[stays]] = new[stays], 0
        kept.extend(new[stays].tolist())
        progress(int(new[-1]) + 1, n)
    return nearest, to_nearest


def _distances_to_all(view: IndexView, keys: Keys, index: int) -> Ints64:
    """Distances (n,) of one frame to all, in the order of `keys`."""
    query, in_tail = _rows(view, keys[index : index + 1])[0], view.tail.places.of(keys)
    rows, found = in_tail[in_tail >= 0], np.empty(len(keys), np.int64)
    found[in_tail >= 0] = distances(query, view.tail.signatures, view.metric, rows)
    if view.generation is not None:
        found[in_tail < 0] = view.generation.distances_to(query, keys[in_tail < 0], view.metric)
    return found


def _silent(_done: int, _total: int) -> None:
    """Nobody listens."""


def _rows(view: IndexView, keys: Keys) -> Bytes:
    return signatures_of(keys, view.generation, view.tail)


def _bytes(engine: Engine, weight: Weight) -> int:
    return weight.upload_bytes + (engine.store.blobs.size(weight.artifact) or 0)
