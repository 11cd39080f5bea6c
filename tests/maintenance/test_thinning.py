"""Thinning: what is proposed is what the sentences say, and only that is lost, only when told."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sceneprint.engine import Engine
from sceneprint.errors import InvalidRequest, UnknownMap
from sceneprint.geometry.retrieval.ranking import diversify, pairwise_distances
from sceneprint.maintenance import thin
from sceneprint.maintenance.thin import carry_out, propose
from sceneprint.settings import Settings
from sceneprint.store import queue
from sceneprint.store.maps import add_frame, find_map
from sceneprint.store.signatures import StoredSignature, index_frame
from sceneprint.types import Bytes
from sceneprint_client.api import NewMap

N = 60


@pytest.fixture(scope="module")
def vectors() -> Bytes:
    """Signatures of places, each seen a few times from a little further, in mixed order."""
    rng = np.random.default_rng(3)
    places = rng.integers(0, 30, (12, 448))
    seen = [places[i % 12] + rng.integers(0, 1 + i // 12, 448) for i in range(N - 2)]
    seen += [seen[5], seen[40]]
    return np.stack(seen).astype(np.uint8)


@pytest.fixture(scope="module")
def filled(vectors: Bytes, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder whose map `hall` has frames of these signatures, and small blobs."""
    folder = tmp_path_factory.mktemp("filled") / "data"
    camera = {"width": 4, "height": 3, "fx": 1.0, "fy": 1.0, "cx": 1.5, "cy": 1.0}
    with Engine(Settings(data_dir=folder)) as engine:
        engine.create_map(NewMap(name="hall", model="depth"))
        blobs = [[engine.store.blobs.put(bytes([i, kind]) * half)
                  for kind, half in ((0, 50), (1, 10))] for i in range(N)]  # fmt: skip
        with engine.store.database.write() as connection:
            for i, vector in enumerate(vectors):
                row = find_map(connection, "hall")
                values: dict[str, Any] = {
                    "content_id": str(i), "blob": blobs[i][0], "bytes": 100, "intrinsics": camera,
                    "depth_scale": 1000.0, "depth_along_ray": False, "robot": None,
                    "session": "even" if i % 2 == 0 else "odd", "captured_at": None, "tags": [],
                    "pose_parent": None, "pose": None,
                }  # fmt: skip
                frame = add_frame(connection, row.number, values)
                made = StoredSignature(row.model_id, vector.tobytes(), blobs[i][1], (1,), (1,))
                index_frame(connection, frame, made)
                queue.enqueue(connection, "sign", frame.number)
    return folder


@pytest.fixture
def make(filled: Path, tmp_path: Path) -> Iterator[Callable[..., Engine]]:
    """An engine on a copy of that folder."""
    opened: list[Engine] = []

    def make(**more: object) -> Engine:
        shutil.copytree(filled, tmp_path / "data")
        opened.append(Engine(Settings.model_validate({"data_dir": tmp_path / "data"} | more)))
        return opened[-1]

    yield make
    for engine in opened:
        engine.close()


def ids(engine: Engine) -> list[str]:
    return [frame.frame_id for frame in engine.list_frames("hall").items]


def noted(steps: list[tuple[int, int]]) -> Callable[[int, int], None]:
    return lambda *at: steps.append(at)


def indexed(engine: Engine) -> int:
    return engine.get_map("hall").frames.get("indexed", 0)


@pytest.mark.parametrize("how", [{"keep": 9}, {"novelty": 0.2}])
@pytest.mark.parametrize("tail_frames", [1000, 20])
def test_nothing_changes_before_it_is_carried_out(
    make: Callable[..., Engine], vectors: Bytes, how: dict[str, Any], tail_frames: int
) -> None:
    """Whether the signatures lie in an index, in its tail, or in the database."""
    engine = make(tail_frames=tail_frames)
    names = ids(engine)
    assert engine.publish_due() == (tail_frames == 20)
    engine.delete_frame("hall", names[30])
    before = engine.get_map("hall")
    proposal = propose(engine, "hall", **how)
    assert engine.get_map("hall") == before
    assert proposal.n_frames == N - 1
    lost = [one.frame_id for one in proposal.losses]
    assert 0 < len(lost) < N - 1
    assert names[30] not in lost
    assert [name for name in names if name in set(lost)] == lost  # in the order they came
    told: list[tuple[int, int]] = []
    engine.delete_frame("hall", lost[1])  # somebody is first
    assert carry_out(engine, proposal, noted(told)) == len(lost) - 1
    assert told == [(i + 1, len(lost)) for i in range(len(lost))]
    assert indexed(engine) == N - 1 - len(lost)
    for one in proposal.losses:
        assert engine.get_frame("hall", one.frame_id).state == "deleted"
        assert engine.get_frame("hall", one.like).state == "indexed"
    # a second time there is nothing left to say
    again = propose(engine, "hall", **how)
    assert (again.losses, again.freed_bytes, again.shares) == ((), 0, (0.0, 0.0))
    assert again.n_frames == indexed(engine)


def test_novelty_is_what_its_sentence_says(
    make: Callable[..., Engine], vectors: Bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(thin, "BLOCK", 7)
    monkeypatch.setattr(thin, "KEPT_BLOCK", 4)
    engine = make()
    names = ids(engine)
    d0 = engine.view("hall")[1].unrelated_distance
    among = pairwise_distances(vectors, "l2")
    for share in (0.0, 0.2, 0.3, 0.4, 0.55):
        kept: list[int] = []
        expected = []
        for i in range(N):
            near = [among[i, j] for j in kept]
            if not near or np.sqrt(min(near) / d0) > share:
                kept.append(i)
            else:
                expected.append(
                    (names[i], names[kept[int(np.argmin(near))]], np.sqrt(min(near) / d0))
                )
        steps: list[tuple[int, int]] = []
        proposal = propose(engine, "hall", novelty=share, progress=noted(steps))
        assert [(one.frame_id, one.like, one.share) for one in proposal.losses] == expected
        assert proposal.freed_bytes == len(expected) * (100 + 20 + 448)
        assert steps == [(min(i + 7, N), N) for i in range(0, N, 7)]
        shares = [share for _, _, share in expected]
        assert proposal.shares == (np.median(shares), max(shares))
    assert len(expected) > 30
    assert [one.frame_id for one in propose(engine, "hall", novelty=0.0).losses] == names[-2:]


def test_the_most_telling_are_those_of_the_determinant(
    make: Callable[..., Engine], vectors: Bytes
) -> None:
    """All 60 give the scale, so the choice is that of `diversify` among frames equally near."""
    engine = make()
    names = ids(engine)
    d0 = engine.view("hall")[1].unrelated_distance
    among = pairwise_distances(vectors, "l2")
    for keep in (1, 5, 12, 57):
        chosen = diversify(np.full(N, 1.0), among, keep).indices
        steps: list[tuple[int, int]] = []
        proposal = propose(engine, "hall", keep=keep, progress=noted(steps))
        lost = [i for i in range(N) if i not in chosen]
        assert [one.frame_id for one in proposal.losses] == [names[i] for i in lost]
        for i, one in zip(lost, proposal.losses, strict=True):
            assert one.share == np.sqrt(among[i, chosen].min() / d0)
        assert steps == [(i + 1, keep) for i in range(keep)]
    # of 60 two are exact duplicates: they go, whatever is asked for
    assert [one.frame_id for one in propose(engine, "hall", keep=59).losses] == names[-2:]
    assert propose(engine, "hall", keep=60).losses == ()
    assert propose(engine, "hall", keep=1000).losses == ()


def test_the_scale_is_that_of_a_sample_by_its_seed(
    make: Callable[..., Engine], vectors: Bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(thin, "SAMPLE", 4)
    scales: list[float] = []

    def spied(distances_of: Any, n: int, k: int, sigma: float) -> Any:
        scales.append(sigma)
        return summarise(distances_of, n, k, sigma)

    summarise = thin.summarise
    monkeypatch.setattr(thin, "summarise", spied)
    engine = make()
    one, same, other = (propose(engine, "hall", keep=20, seed=seed) for seed in (1, 1, 2))
    assert one == same
    assert scales[0] == scales[1] != scales[2]
    drawn = np.sort(np.random.default_rng(1).choice(N, 4, replace=False))
    among = pairwise_distances(vectors[drawn], "l2")
    assert scales[0] == np.median(among[np.triu_indices(4, 1)])
    assert len(other.losses) == 40


def test_only_a_session_is_looked_at(make: Callable[..., Engine], vectors: Bytes) -> None:
    engine = make(tail_frames=20)
    names = ids(engine)
    engine.publish_due()
    proposal = propose(engine, "hall", keep=10, session="odd")
    assert proposal.n_frames == N // 2
    assert {one.frame_id for one in proposal.losses} < set(names[1::2])
    assert {one.like for one in proposal.losses} <= set(names[1::2])
    assert len(proposal.losses) == 20
    assert propose(engine, "hall", novelty=2.0, session="nobody's").n_frames == 0
    assert propose(engine, "hall", keep=3, session="nobody's").losses == ()
    alone = propose(engine, "hall", novelty=2.0, session="even")
    assert [one.like for one in alone.losses] == [names[0]] * (N // 2 - 1)


def test_what_cannot_be_asked_for(
    make: Callable[..., Engine], vectors: Bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine = make()
    with pytest.raises(UnknownMap):
        propose(engine, "nowhere", keep=3)
    for how in ({}, {"keep": 3, "novelty": 0.1}):
        with pytest.raises(InvalidRequest, match="not both"):
            propose(engine, "hall", **how)
    monkeypatch.setattr(thin, "CHOICE_BYTES", 8 * N * 7 - 1)
    assert len(propose(engine, "hall", keep=6).losses) == N - 6
    with pytest.raises(InvalidRequest, match=r"Choosing 7 of 60 frames would take .* --novelty"):
        propose(engine, "hall", keep=7)
    assert propose(engine, "hall", novelty=0.1).n_frames == N


def test_a_frame_stays_whose_like_is_gone(make: Callable[..., Engine]) -> None:
    engine = make()
    proposal = propose(engine, "hall", novelty=0.2)
    gone = proposal.losses[0].like
    spared = {one.frame_id for one in proposal.losses if one.like == gone}
    engine.delete_frame("hall", gone)
    assert carry_out(engine, proposal) == len(proposal.losses) - len(spared)
    left = {frame.frame_id for frame in engine.list_frames("hall", limit=1000).items}
    assert spared <= left
