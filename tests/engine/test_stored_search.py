"""PostgreSQL searches what a node does not hold; exact distances decide, there and here."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import event, select, text

from benchmarks.fleet.bulk_load import fill, walk
from sceneprint.engine import Engine
from sceneprint.engine.search import local_index, retrieval, stored_maps
from sceneprint.engine.search import query as querying
from sceneprint.errors import InvalidRequest
from sceneprint.geometry.retrieval.ranking import distances
from sceneprint.maintenance.snapshot.postgres_restore import copy_into
from sceneprint.models import Model
from sceneprint.settings import Settings
from sceneprint.store import open_database
from sceneprint.store.maps import find_frame, find_map
from sceneprint.store.postgres import vectors
from sceneprint.store.signatures import StoredSignature, remove_signature, replace_signature
from sceneprint.store.tables import frames, signatures
from sceneprint.types import Bytes
from sceneprint_client.api import Answer, ExplainedFrame, NamedFrame, Query, SeveralQuery

Make = Callable[..., Engine]
#: Frames of both maps, and bytes of a signature.
SIZES, LENGTH = {"hall": 900, "yard": 700}, 64
#: Frames that pgvector proposes: twice as many as are ranked.
CANDIDATES = 400
BOTH = ["hall", "yard"]


@pytest.fixture
def make(postgres_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    """Engines on one database, each a node of its own folder, that counts frames each time."""
    monkeypatch.setattr(stored_maps, "_COUNTED", 0)
    opened: list[Engine] = []

    def engine(node: str = "a", search: str = "database", **more: object) -> Engine:
        given = {"data_dir": tmp_path / node, "database_url": postgres_url, "search": search}
        opened.append(Engine(Settings.model_validate(given | more)))
        return opened[-1]

    yield engine
    for one in reversed(opened):
        one.close()


@pytest.fixture(scope="session")
def places() -> dict[str, Bytes]:
    """Signatures of both maps: two walks in each."""
    return {
        name: walk(n, LENGTH, seed=i, walks=2) for i, (name, n) in enumerate(sorted(SIZES.items()))
    }


@pytest.fixture
def filled(make: Make, places: dict[str, Bytes], whitened_model: Model) -> Engine:
    """A node that has nothing of two maps but the database; every tenth frame is of run `r`."""
    engine = make()
    for name, made in places.items():
        known = [{"session": "r" if i % 10 == 0 else None} for i in range(len(made))]
        fill(engine.store.database, name, whitened_model, made, known)
    return engine


def complete(engine: Engine) -> None:
    """Make and fill the tables of vectors."""
    tables, end = engine._vector_tables, time.monotonic() + 90
    tables._not_before = 0.0
    while tables.run():
        assert time.monotonic() < end
    with engine.store.database.read() as connection:
        assert vectors.complete_dimensions(connection) == {LENGTH}


def held(engine: Engine) -> set[int]:
    """Numbers of the frames that have a vector."""
    with engine.store.database.read() as connection:
        asked = text(f"SELECT frame_number FROM {vectors.table_of(LENGTH)}")
        return set(connection.execute(asked).scalars())


def row_of(engine: Engine, name: str, frame: str) -> Any:
    with engine.store.database.read() as connection:
        return find_frame(connection, find_map(connection, name), frame)


def kind_of(engine: Engine, name: str) -> str:
    """Who searches a map that an engine is asked about."""
    database = engine.store.database
    with database.read() as connection:
        (view,) = engine._readers.views(connection, database, [find_map(connection, name)])
    return view.kind


def ask(engine: Engine, frame: str, maps: list[str] | None = None, **more: Any) -> Answer:
    """The fifty nearest frames of a stored one."""
    query = Query.model_validate({"stages": ["retrieve"], "k": 50, "keep": False} | more)
    named = NamedFrame(map=frame.rpartition("-")[0], frame_id=frame)
    return engine.queries.stored(maps or ["hall"], named, query)


def found(answer: Answer) -> list[tuple[str, int]]:
    return [(one.frame_id, one.distance) for one in answer.matches]


def nearest(
    places: dict[str, Bytes], frame: str, maps: list[str], count: int, step: int = 1
) -> list[tuple[str, int]]:
    """The naive answer: all compared; equal distances in the order in which frames came."""
    home, _, number = frame.rpartition("-")
    query, listed = places[home][int(number) - 1], []
    for order, name in enumerate(sorted(places)):
        if name in maps:
            apart = distances(query, places[name], "l2")
            listed += [(d, order, i, name) for i, d in enumerate(apart.tolist()) if i % step == 0]
    own = (home, int(number) - 1)
    kept = [one for one in sorted(listed) if (one[3], one[2]) != own][:count]
    return [(f"{name}-{i + 1}", d) for d, _, i, name in kept]


def recall(answers: list[Answer], wanted: list[list[tuple[str, int]]]) -> float:
    """Of the ten nearest, by distance: which of two equal ones is no matter."""
    shares = [
        np.mean([distance <= exact[9][1] for _, distance in found(answer)[:10]])
        for answer, exact in zip(answers, wanted, strict=True)
    ]
    return float(np.mean(shares))


def by_graph(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    """Link so few vectors, and search them through the graph whatever it costs."""
    monkeypatch.setattr(vectors, "GRAPH_FROM", 100)
    monkeypatch.setattr(vectors, "_STEP_COST", 0.0)
    assert vectors.add_graph(engine.store.database, LENGTH)
    assert not vectors.add_graph(engine.store.database, LENGTH)
    with engine.store.database.read() as connection:
        assert vectors._by_graph(connection, LENGTH, CANDIDATES, 1600)


def test_the_database_a_node_and_the_exact_scan_agree(
    filled: Engine, make: Make, places: dict[str, Bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    node = make("b", "local")
    asked = [f"hall-{i}" for i in range(5, 900, 75)]
    wanted = [nearest(places, one, BOTH, 50) for one in asked]
    assert [found(ask(node, one, BOTH)) for one in asked] == wanted
    assert [found(ask(filled, one, BOTH)) for one in asked] == wanted  # no table yet: by itself
    complete(filled)
    answers = [ask(filled, one, BOTH) for one in asked]
    assert {(one.exact, one.counts.compared) for one in answers} == {(True, 1599)}
    assert [found(one) for one in answers] == wanted
    by_graph(filled, monkeypatch)
    exact = ask(filled, asked[3], BOTH, exact=True)
    assert (exact.exact, exact.counts.compared, found(exact)) == (True, 1599, wanted[3])
    recalls = []
    for build in range(3):  # pgvector links at random, by no seed: two graphs of 80 had .93, .98
        if build:
            with filled.store.database.write() as connection:
                connection.exec_driver_sql(f"DROP INDEX ix_{vectors.table_of(LENGTH)}_vector")
            assert vectors.add_graph(filled.store.database, LENGTH)
        for maps in (BOTH, ["yard"]):
            answers = [ask(filled, one, maps) for one in asked]
            assert {(one.exact, one.counts.compared) for one in answers} == {(False, CANDIDATES)}
            recalls.append(recall(answers, [nearest(places, one, maps, 10) for one in asked]))
    assert np.mean(recalls) >= 0.97


def test_maps_are_asked_in_one_statement_and_a_filter_finds_all_it_leaves(
    filled: Engine, places: dict[str, Bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    complete(filled)
    by_graph(filled, monkeypatch)
    statements: list[str] = []
    engine = filled.store.database._engine
    event.listen(engine, "before_cursor_execute", lambda *given: statements.append(given[2]))
    answer = ask(filled, "yard-40", BOTH)
    assert sum(f"FROM {vectors.table_of(LENGTH)} WHERE" in one for one in statements) == 1
    assert answer.per_map is not None
    assert sum(one.counts.compared for one in answer.per_map.values()) == CANDIDATES
    few = ask(filled, "hall-11", ["hall"], filter={"session": ["r"]}, k=10)
    assert found(few) == nearest(places, "hall-11", ["hall"], 10, step=10)
    assert (few.counts.passed, few.counts.compared, few.exact) == (89, 89, True)
    known = {"exclude_frames": [f"hall-{i}" for i in range(1, 881)]}
    left = ask(filled, "hall-900", filter=known, k=10)
    after = [one for one in nearest(places, "hall-900", ["hall"], 900) if int(one[0][5:]) > 880]
    assert found(left) == after[:10]
    # and where the filter leaves more than the candidates, these are of what it leaves
    many = ask(filled, "hall-3", BOTH, filter={"exclude_frames": ["hall-4", "hall-2"]}, k=10)
    assert (many.counts.passed, many.exact) == (1597, False)
    wanted = [one for one in nearest(places, "hall-3", BOTH, 12) if one[0] not in
              ("hall-4", "hall-2")]  # fmt: skip
    assert found(many) == wanted[:10]


def test_all_maps_of_a_fleet_are_asked_at_once_where_the_database_searches(
    filled: Engine, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(querying, "MOST_MAPS", 1)
    everywhere = SeveralQuery(maps="*")
    with pytest.raises(InvalidRequest, match="There are 2 maps, but a query can search at most 1"):
        filled.queries.maps_of(everywhere)
    complete(filled)
    assert filled.queries.maps_of(everywhere) == BOTH
    assert filled.queries.maps_of(everywhere, lambda name: name == "yard") == ["yard"]
    with pytest.raises(InvalidRequest, match="can search at most 1"):
        make("b", "local").queries.maps_of(everywhere)


def test_a_frame_deleted_during_the_search_or_before_is_not_found_afterwards(
    filled: Engine, places: dict[str, Bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    complete(filled)
    before = ask(filled, "hall-100")
    gone, proposed = before.matches[0].frame_id, vectors.nearest
    number = row_of(filled, "hall", gone).number

    def late(*given: Any, **more: Any) -> Any:
        monkeypatch.setattr(vectors, "nearest", proposed)
        chosen = proposed(*given, **more)
        filled.delete_frame("hall", gone)
        return chosen

    monkeypatch.setattr(vectors, "nearest", late)
    during = ask(filled, "hall-100")  # of the state before
    assert {gone, *(one for one, _ in found(during))} == {one for one, _ in found(before)}
    after = ask(filled, "hall-100")
    wanted = [one for one in nearest(places, "hall-100", ["hall"], 51) if one[0] != gone]
    assert found(after)[:10] == wanted[:10]
    assert after.counts.map == SIZES["hall"] - 2  # itself, too
    assert number not in held(filled)
    filled.delete_map("yard")
    assert len(held(filled)) == SIZES["hall"] - 1


def test_a_signature_has_its_vector_in_the_same_commit(
    filled: Engine, whitened_model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    database = filled.store.database
    twin = walk(3, LENGTH, seed=9)[2]
    complete(filled)
    names = fill(
        database, "hall", whitened_model, np.stack([twin, twin])
    )  # without vectors, as no worker stored them
    rows = [row_of(filled, "hall", name) for name in names]
    made = StoredSignature(whitened_model.id, twin.tobytes(), "0" * 64, [1], [1])
    assert not {row.number for row in rows} & held(filled)
    with database.write() as connection:
        assert not replace_signature(connection, rows[0], made)  # the same bytes
    assert rows[0].number in held(filled)
    assert found(ask(filled, names[1], k=1)) == [(names[0], 0)]
    # another signature takes the place of the vector too
    far = replace(made, vector=(255 - twin).tobytes())
    with database.write() as connection:
        assert replace_signature(connection, rows[0], far)
    assert found(ask(filled, names[1], k=1))[0][0] != names[0]
    with database.write() as connection:
        asked = f"SELECT CAST(vector AS real[]) FROM {vectors.table_of(LENGTH)} WHERE frame_number"
        kept = connection.execute(text(f"{asked} = {rows[0].number}")).scalar_one()
        assert kept == (127 - twin.astype(int)).tolist()
        remove_signature(connection, rows[0].number, whitened_model.id)
    assert rows[0].number not in held(filled)


def test_vectors_are_filled_in_beside_queries_and_made_again_where_they_are_lost(
    filled: Engine, places: dict[str, Bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sceneprint.engine.upkeep.index_upkeep.FILL_S", 0.0)
    database, wanted = filled.store.database, nearest(places, "hall-500", ["hall"], 10)
    tables = filled._vector_tables
    blocks = 0
    while tables.run():  # a block in each turn
        answer = ask(filled, "hall-500", k=10)
        assert (found(answer), answer.exact) == (wanted, True)
        blocks += 1
        assert blocks < 20
    assert blocks == 8  # of 200 frames
    assert len(held(filled)) == 1600
    with database.write() as connection:
        connection.execute(text(f"DROP TABLE {vectors.table_of(LENGTH)}"))
    assert kind_of(filled, "hall") == "local"  # as there is nothing to ask
    assert found(ask(filled, "hall-500", k=10)) == wanted
    complete(filled)
    assert kind_of(filled, "hall") == "database"
    assert found(ask(filled, "hall-500", k=10)) == wanted
    with database.write() as connection:
        vectors.drop_tables(connection)
        assert vectors.complete_dimensions(connection) == frozenset()
    complete(filled)
    assert len(held(filled)) == 1600


def test_a_restore_leaves_no_table_that_lacks_what_was_restored(
    make: Make, whitened_model: Model, places: dict[str, Bytes], tmp_path: Path
) -> None:
    file = tmp_path / "one.db"
    one = open_database(f"sqlite:///{file}")
    fill(one, "hall", whitened_model, places["hall"][:20])
    one.close()
    engine = make()
    database = engine.store.database
    with database.write() as connection:
        assert vectors.make_table(connection, LENGTH) is None
    with database.write() as connection:
        assert vectors.fill(connection, LENGTH)  # of nothing: it is complete
    with closing(sqlite3.connect(file)) as source, database.write() as connection:
        assert vectors.complete_dimensions(connection) == {LENGTH}
        copy_into(connection, source)
        assert vectors.complete_dimensions(connection) == frozenset()
    complete(engine)
    assert len(held(engine)) == 20


def test_a_node_asks_the_database_only_for_what_it_has_not(
    filled: Engine, make: Make, places: dict[str, Bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    complete(filled)
    wanted = nearest(places, "hall-321", ["hall"], 10)
    node = make("b", "auto", tail_frames=1)
    monkeypatch.setattr(local_index, "READ_MOST", 600)
    monkeypatch.setattr(retrieval, "READ_MOST", 600)
    far = ask(node, "hall-321", k=10)
    assert (found(far), far.index_generation, far.exact) == (wanted, 0, True)
    assert [kind_of(node, name) for name in BOTH] == ["database"] * 2
    assert node.publish_due() == 2
    near = ask(node, "hall-321", k=10)
    assert (found(near), near.index_generation, near.exact) == (wanted, 1, True)
    assert [kind_of(node, name) for name in BOTH] == ["local"] * 2


def test_maps_of_psi_are_compared_whole_by_l1_without_index_or_vectors(
    make: Make, small_model: Model
) -> None:
    engine = make(tail_frames=1)
    made = walk(300, small_model.signature_bytes, seed=4)
    names = fill(engine.store.database, "old", small_model, made)
    assert not engine._vector_tables.run()
    with engine.store.database.read() as connection:
        assert vectors.complete_dimensions(connection) == frozenset()
    answer = ask(engine, names[7], ["old"], k=5)
    apart = distances(made[7], made, "l1")
    wanted = [int(i) for i in np.argsort(apart, kind="stable") if i != 7][:5]
    assert found(answer) == [(names[i], int(apart[i])) for i in wanted]
    assert (answer.exact, answer.index_generation, answer.counts.compared) == (True, 0, 299)


def test_a_damaged_signature_costs_its_frame_alone(filled: Engine) -> None:
    complete(filled)
    before = ask(filled, "hall-77", k=10)
    hurt = before.matches[1].frame_id
    with filled.store.database.write() as connection:
        number = find_frame(connection, find_map(connection, "hall"), hurt).number
        own = signatures.c.frame_number == number
        connection.execute(signatures.update().where(own).values(checksum=1))
    after = ask(filled, "hall-77", k=9)
    assert found(after) == [one for one in found(before) if one[0] != hurt]
    with filled.store.database.read() as connection:
        hall = find_map(connection, "hall")
        (view,) = filled._readers.views(connection, filled.store.database, [hall])
        count = connection.execute(
            select(frames.c.number).where(frames.c.map_number == hall.number)
        ).all()
    assert isinstance(view, stored_maps.Stored)
    hits = view.search(walk(1, LENGTH, seed=0)[0], 950, dead=frozenset(), exact=True)
    assert (view.damaged, len(hits)) == ({number}, len(count) - 1)
    with filled.store.database.write() as connection:  # of all but the last thirty
        few = signatures.c.frame_number <= sorted(one.number for one in count)[-31]
        connection.execute(signatures.update().where(few).values(checksum=1))
    assert len(view.search(walk(1, LENGTH, seed=0)[0], 50, dead=frozenset())) == 30


def test_why_a_frame_is_not_found_says_that_the_graph_missed_it(
    filled: Engine, places: dict[str, Bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    complete(filled)
    by_graph(filled, monkeypatch)
    proposed = vectors.nearest
    barred = {row_of(filled, "hall", f"hall-{i}").number for i in (2, 3)}

    def poor(*given: Any, exact: bool) -> Any:
        near, whole = proposed(*given, exact=exact)
        return [one for one in near if exact or one not in barred], whole

    monkeypatch.setattr(vectors, "nearest", poor)

    def explained(frame: str, **more: Any) -> ExplainedFrame:
        told = ask(filled, "hall-1", explain_frame=frame, **more).explained_frame
        assert told is not None
        return told

    missed, there = explained("hall-2"), explained("hall-2", exact=True)
    assert (missed.lost_at, missed.shortlisted, missed.ranked) == ("shortlist", False, False)
    assert missed.reason == (
        f"pgvector in the database missed it, although its rank is {missed.rank}; "
        "query with `exact`"
    )
    assert (there.lost_at, there.shortlisted) == (None, True)
    assert (there.rank, there.distance) == (missed.rank, missed.distance)
    far = explained(nearest(places, "hall-1", ["hall"], 300)[249][0])
    assert (far.lost_at, far.shortlisted, far.rank) == ("ranking", True, 250)


def test_a_database_that_may_not_have_pgvector_leaves_all_to_the_node(
    filled: Engine, places: dict[str, Bytes], caplog: pytest.LogCaptureFixture
) -> None:
    with filled.store.database.write() as connection:
        connection.execute(text(
            "CREATE FUNCTION no() RETURNS event_trigger LANGUAGE plpgsql AS "
            "$$ BEGIN RAISE insufficient_privilege USING MESSAGE = 'not here'; END $$"
        ))  # fmt: skip
        connection.execute(text(
            "CREATE EVENT TRIGGER no ON ddl_command_start WHEN TAG IN ('CREATE EXTENSION') "
            "EXECUTE FUNCTION no()"
        ))  # fmt: skip
    assert not filled._vector_tables.run()
    assert "database search disabled: the extension `vector` cannot be made" in caplog.text
    answer = ask(filled, "hall-7", k=10)
    assert found(answer) == nearest(places, "hall-7", ["hall"], 10)
    assert (answer.exact, answer.counts.compared) == (True, 899)
