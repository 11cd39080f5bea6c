"""Maps that Qdrant searches: the answers of a node that does without, on both databases."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from sqlalchemy import update

from benchmarks.fleet.bulk_load import fill, walk
from sceneprint import settings as settings_module
from sceneprint.engine import Engine
from sceneprint.engine.admin.statistics import index_states
from sceneprint.engine.search import local_index
from sceneprint.engine.search.local_index import IndexView, index_folder
from sceneprint.errors import InvalidRequest
from sceneprint.index import manifests
from sceneprint.index.generation_files import read_manifest
from sceneprint.index.qdrant_shard import Shard
from sceneprint.maintenance.fsck.indexes import describe_index, verify_index
from sceneprint.models import Model
from sceneprint.settings import Settings
from sceneprint.store.maps import find_map
from sceneprint.store.tables import maps
from sceneprint.types import Bytes
from sceneprint_client.api import Answer, NamedFrame, Query

Node = Callable[..., Engine]
#: Frames of a map, and of them those that come when its index is there.
FRAMES, LATE = 600, 40


@pytest.fixture(autouse=True)
def _always_look(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local_index, "_LOOK_S", 0.0)


@pytest.fixture
def searches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many rows Qdrant was asked for, each time."""
    counts, real = list[int](), Shard.nearest

    def nearest(self: Shard, query: Bytes, count: int, free: Any) -> Any:
        counts.append(count)
        return real(self, query, count, free)

    monkeypatch.setattr(Shard, "nearest", nearest)
    return counts


@pytest.fixture(params=["l2", "l1"])
def model(request: pytest.FixtureRequest, whitened_model: Model, small_model: Model) -> Model:
    """One whose maps always have an index, and one whose maps have it with Qdrant alone."""
    return {"l2": whitened_model, "l1": small_model}[request.param]


@pytest.fixture
def made(model: Model) -> Bytes:
    return walk(FRAMES, model.signature_bytes, seed=3, walks=2)


@pytest.fixture
def node(make_engine: Node, store_url: str, tmp_path: Path) -> Node:
    """An engine on the common database, with a folder of its own."""

    def make(name: str, search: str = "qdrant", **more: object) -> Engine:
        given = {"database_url": store_url, "search": search, "tail_frames": 10, "undo_s": 0}
        return make_engine(tmp_path / name, **{**given, **more})

    return make


@pytest.fixture
def filled(node: Node, made: Bytes, model: Model) -> Engine:
    """A node whose map has an index but for the last frames; every tenth frame is of run `r`."""
    engine = node("a")
    known = [{"session": "r" if i % 10 == 0 else None} for i in range(FRAMES)]
    fill(engine.store.database, "hall", model, made[:-LATE], known[:-LATE])
    assert engine.publish_due() == 1
    fill(engine.store.database, "hall", model, made[-LATE:], known[-LATE:])
    return engine


#: Of files in a node's own folder, in which the database has no part.
of_files = pytest.mark.parametrize(
    "store_url", ["sqlite", pytest.param("postgresql", marks=pytest.mark.thorough)], indirect=True
)


def ask(engine: Engine, number: int, **more: Any) -> Answer:
    query = Query.model_validate({"stages": ["retrieve"], "k": 50, "keep": False} | more)
    return engine.queries.stored(["hall"], NamedFrame(map="hall", frame_id=f"hall-{number}"), query)


def found(answer: Answer) -> tuple[list[tuple[str, int]], int, bool]:
    return [(one.frame_id, one.distance) for one in answer.matches], answer.frames, answer.exact


def naive(model: Model, made: Bytes, number: int, alive: set[int]) -> list[tuple[str, int]]:
    power = {"l1": 1, "l2": 2}[model.metric]
    apart = (np.abs(made.astype(int) - made[number - 1]) ** power).sum(axis=1)
    ranked = sorted((int(apart[i - 1]), i) for i in alive - {number})
    return [(f"hall-{i}", distance) for distance, i in ranked[:50]]


def view(engine: Engine) -> IndexView:
    return engine.view("hall")[2]


def files(engine: Engine) -> list[str]:
    """Kinds of the files of the newest generation, of each segment the same."""
    with engine.store.database.read() as connection:
        folder = index_folder(engine.settings.indexes, find_map(connection, "hall"))
    listed = manifests(folder)
    (kinds,) = {
        tuple(name.rpartition(".")[2] for name, _ in one.files if not name.endswith(".gone"))
        for one in read_manifest(listed[0][1]).segments
    }
    return list(kinds)


def test_answers_are_those_of_a_node_without_it(
    filled: Engine, node: Node, made: Bytes, model: Model, searches: list[int]
) -> None:
    """Deletions, filters, exact queries, new frames, and a new generation."""
    plain, alive = node("b", "local"), set(range(1, FRAMES + 1))
    for step in range(3):
        for number in (5, 78, 300, 591):
            if number not in alive:
                continue
            wanted = naive(model, made, number, alive)
            for more in ({}, {"exact": True}, {"filter": {"session": "r"}}):
                answer, local = ask(filled, number, **more), ask(plain, number, **more)
                assert found(answer) == found(local)
                assert answer.exact
                assert len(answer.matches) == 50
                if "filter" not in more:
                    assert found(answer)[0] == wanted
        for number in range(70 + step, 140, 7):
            if number in alive - {78}:
                filled.delete_frame("hall", f"hall-{number}")
                alive.discard(number)
        if step == 1:
            assert filled.publish_due() == 1
    assert view(filled).generation is not None
    assert view(filled).number == 2
    assert len(searches) >= 24


def test_a_node_that_starts_again_reads_nothing_of_the_map(
    filled: Engine, node: Node, made: Bytes, model: Model, searches: list[int]
) -> None:
    before = found(ask(filled, 5))
    filled.close()
    searches.clear()
    again = node("a")
    assert found(ask(again, 5)) == before
    assert searches
    held = view(again)
    assert held.generation is not None
    assert all(one.shard is not None for one in held.generation.segments)
    assert (len(held.generation), len(held.tail)) == (FRAMES - LATE, LATE)


@of_files
@pytest.mark.parametrize("what", ["truncated", "removed", "swapped"])
def test_a_damaged_shard_is_passed_over_and_made_anew(
    filled: Engine, node: Node, made: Bytes, model: Model, what: str
) -> None:
    wanted = found(ask(filled, 5))
    (shard,) = (filled.settings.indexes).glob("hall-*/*.qdrant")
    (segment,) = shard.rglob("segment.json")
    if what == "truncated":
        segment.write_bytes(segment.read_bytes()[:-5])
    elif what == "removed":
        shutil.rmtree(shard)
    else:
        (chunk,) = shard.rglob("chunk_0.mmap")
        with chunk.open("r+b") as file:
            file.write(bytes(100))
    healing = node("a", scrub_s=1)
    assert found(ask(healing, 5)) == wanted
    assert view(healing).generation is None
    assert [one for one in verify_index(healing, "hall") if "qdrant" in one]
    (healing.settings.indexes / ".scrubbed").unlink(missing_ok=True)
    published = sum(healing.publish_due() for _ in range(30))
    assert published == 1
    assert found(ask(healing, 5)) == wanted
    held = view(healing)
    assert held.generation is not None
    assert all(one.shard is not None for one in held.generation.segments)
    assert healing.rebuild_index("hall") == 3
    assert healing.rebuild_index("hall") == 4  # the damaged one is kept no more
    assert verify_index(healing, "hall") == []


def test_an_index_of_another_history_is_not_used(filled: Engine, node: Node) -> None:
    """As of a database that was put back, or whose rows of deleted frames are gone."""
    wanted = found(ask(filled, 5))
    with filled.store.database.write() as connection:
        connection.execute(update(maps).values(pruned_revision=FRAMES - 1))
    fresh = node("a")
    assert found(ask(fresh, 5)) == wanted
    assert view(fresh).generation is None
    assert fresh.publish_due() == 1
    assert found(ask(fresh, 5)) == wanted
    assert len(view(fresh).generation or ()) == FRAMES


@of_files
def test_no_byte_of_a_deleted_frame_is_left(filled: Engine, made: Bytes) -> None:
    secret = made[77].tobytes()[:48]

    def places() -> set[str]:
        return {
            path.suffix
            for path in filled.settings.indexes.rglob("*")
            if path.is_file() and secret in path.read_bytes()
        }

    assert places() == {".faiss", ".mmap"}
    filled.delete_frame("hall", "hall-78")
    assert places() == {".faiss", ".mmap"}
    assert filled.purging.now().indexes == 1
    assert places() == set()
    assert "qdrant" in files(filled)
    assert filled.purging.now().indexes == 0


@of_files
def test_nothing_of_a_map_that_is_deleted_is_left(filled: Engine) -> None:
    assert list(filled.settings.indexes.glob("hall-*/*.qdrant"))
    filled.delete_map("hall")
    filled.publish_due()
    assert list(filled.settings.indexes.glob("hall-*")) == []


@of_files
def test_the_setting_can_change(
    filled: Engine, node: Node, made: Bytes, model: Model, searches: list[int]
) -> None:
    """Back and forth: what is there is used as far as it can be, and then made anew."""
    wanted = found(ask(filled, 5))
    filled.close()
    plain = node("a", "local")
    searches.clear()
    assert found(ask(plain, 5)) == wanted
    fill(plain.store.database, "hall", model, made[:20])
    assert plain.publish_due() == int(model.metric == "l2")
    if model.metric == "l2":
        assert files(plain) == ["keys", "faiss"]
        plain.delete_frame("hall", "hall-2")
        plain.purging.now()  # of the generation before it keeps nothing
    assert list(plain.settings.indexes.glob("hall-*/*.qdrant")) == []
    wanted = found(ask(plain, 5))
    assert not searches
    plain.close()
    again = node("a")
    assert found(ask(again, 5)) == wanted
    assert again.publish_due() == 1
    assert files(again) == ["keys", "faiss", "qdrant"]
    assert found(ask(again, 5)) == wanted
    assert searches


@of_files
def test_an_index_without_a_shard_gets_one(
    filled: Engine, node: Node, whitened_model: Model
) -> None:
    """Though no frame is new."""
    if filled.view("hall")[1].metric == "l1":
        return  # it has none without Qdrant
    plain = node("c", "local")
    assert plain.publish_due() == 1
    assert files(plain) == ["keys", "faiss"]
    plain.close()
    again = node("c")
    assert again.publish_due() == 1
    assert files(again) == ["keys", "faiss", "qdrant"]
    assert again.publish_due() == 0
    assert len(view(again).generation or ()) == FRAMES


def test_it_can_be_looked_at_and_rebuilt(filled: Engine) -> None:
    told = describe_index(filled, "hall", sample=5)
    assert (told.generation, told.frames, told.lag_frames, told.recall) == (1, FRAMES, LATE, None)
    size = filled.view("hall")[1].signature_bytes
    assert 2 * size < told.index_bytes < 2 * size + 600
    assert filled.rebuild_index("hall") == 2
    assert (files(filled), len(view(filled).tail)) == (["keys", "faiss", "qdrant"], 0)
    with filled.store.database.read() as connection:
        (state,) = index_states(connection, filled.settings.indexes)
    assert (state.generation, state.tail) == (2, 0)


@of_files
def test_a_model_that_qdrant_cannot_hold_has_none(
    filled: Engine, node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(local_index, "can_hold", lambda *_: False)
    other, metric = node("d"), filled.view("hall")[1].metric
    assert other.publish_due() == int(metric == "l2")
    if metric == "l1":
        with pytest.raises(InvalidRequest, match="has no index to rebuild"):
            other.rebuild_index("hall")
    else:
        assert files(other) == ["keys", "faiss"]
    assert found(ask(other, 5)) == found(ask(filled, 5))


def test_settings_that_do_not_go_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = {"data_dir": tmp_path, "search": "qdrant"}
    assert Settings.model_validate(given).search == "qdrant"
    with pytest.raises(ValidationError, match="indexes that Qdrant searches are not shared"):
        Settings.model_validate(given | {"index_url": f"file://{tmp_path}/shared"})
    monkeypatch.setattr(settings_module, "find_spec", lambda _name: None)
    with pytest.raises(ValidationError, match=r"run `pip install 'sceneprint\[qdrant\]'`"):
        Settings.model_validate(given)
    assert Settings.model_validate(given | {"search": "local"}).search == "local"
