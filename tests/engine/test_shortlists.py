"""pgvector proposes what FAISS proposes; the signatures themselves decide, on either side."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import event, select, text

from benchmarks.fleet.bulk import fill, walk
from sceneprint.engine import Engine, choosing, coding, querying, readers, searching, stored
from sceneprint.errors import InvalidRequest, StoreLocked
from sceneprint.geometry.retrieval import distances
from sceneprint.models import Model
from sceneprint.schemas import Answer, ExplainedFrame, NamedFrame, Query, SeveralQuery
from sceneprint.settings import Settings
from sceneprint.store import codes, fits, graphs
from sceneprint.store.frames import find_frame
from sceneprint.store.maps import find_map
from sceneprint.store.signatures import StoredSignature, replace_signature
from sceneprint.store.tables import frames, signatures
from sceneprint.types import Bytes

Make = Callable[..., Engine]
#: Frames of both maps: more than a shortlist has, though not many more.
SIZES = {"hall": 900, "yard": 700}


@pytest.fixture
def make(postgres_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Make]:
    """Engines on one database, each a node of its own folder, that counts frames each time."""
    monkeypatch.setattr(choosing, "_COUNTED", 0)
    opened: list[Engine] = []

    def engine(node: str = "a", shortlist: str = "database", **more: object) -> Engine:
        given = {"data_dir": tmp_path / node, "database_url": postgres_url, "shortlist": shortlist}
        opened.append(Engine(Settings.model_validate(given | more)))
        return opened[-1]

    yield engine
    for one in reversed(opened):
        one.close()


@pytest.fixture(scope="session")
def places(small_model: Model) -> dict[str, Bytes]:
    """Signatures of both maps: two walks in each."""
    length = small_model.signature_bytes
    return {
        name: walk(n, length, seed=i, walks=2) for i, (name, n) in enumerate(sorted(SIZES.items()))
    }


@pytest.fixture
def filled(make: Make, places: dict[str, Bytes], small_model: Model) -> Engine:
    """A node that has nothing of two maps but the database; every tenth frame is of run `r`."""
    engine = make()
    for name, made in places.items():
        known = [{"session": "r" if i % 10 == 0 else None} for i in range(len(made))]
        fill(engine.store.database, name, small_model, made, known)
    return engine


def code_all(engine: Engine) -> None:
    """Fit and fill until there is nothing left to do."""
    while engine._coding.run():
        pass


def live(engine: Engine, model: Model) -> fits.Fit:
    with engine.store.database.read() as connection:
        fit = fits.live_fit(connection, model.id)
    assert fit is not None
    return fit


def coded(engine: Engine, fit: fits.Fit) -> set[int]:
    with engine.store.database.read() as connection:
        return set(connection.execute(text(f"SELECT frame_number FROM {fit.table}")).scalars())


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
            apart = distances(query, places[name])
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


def test_both_shortlists_agree_with_the_exact_scan(
    filled: Engine, make: Make, places: dict[str, Bytes], small_model: Model,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    code_all(filled)
    node = make("b", "local", tail_frames=1)
    assert node.publish_due() == 2
    monkeypatch.setattr(searching, "WHOLE", 0)  # else a map so small is compared whole
    both, asked = ["hall", "yard"], [f"hall-{i}" for i in range(5, 900, 75)]
    wanted = [nearest(places, one, both, 10) for one in asked]
    for engine, compared in ((filled, 500), (node, 1000)):  # one for all maps, or one for each
        answers = [ask(engine, one, both) for one in asked]
        assert {(one.exact, one.counts.compared) for one in answers} == {(False, compared)}
        assert recall(answers, wanted) >= 0.99
    exact = [ask(engine, asked[3], both, exact=True) for engine in (filled, node)]
    assert [one.exact for one in exact] == [True, True]
    assert found(exact[0]) == found(exact[1]) == nearest(places, asked[3], both, 50)
    # and through the graph, which a table so small is given here
    monkeypatch.setattr(graphs, "GRAPH_FROM", 100)
    monkeypatch.setattr(graphs, "_STEP_COST", 0.0)
    with filled.store.database.write() as connection:
        graphs.add_graph(connection, live(filled, small_model))
    with filled.store.database.read() as connection:
        assert graphs._by_graph(connection, live(filled, small_model), 500, 1600)
    for maps in (both, ["yard"]):
        answers = [ask(filled, one, maps) for one in asked]
        assert {one.counts.compared for one in answers} == {500}
        assert recall(answers, [nearest(places, one, maps, 10) for one in asked]) >= 0.99


def test_maps_are_asked_in_one_statement_and_a_filter_finds_all_it_leaves(
    filled: Engine, places: dict[str, Bytes], small_model: Model
) -> None:
    code_all(filled)
    statements: list[str] = []
    engine = filled.store.database._engine
    event.listen(engine, "before_cursor_execute", lambda *given: statements.append(given[2]))
    both = ["hall", "yard"]
    answer = ask(filled, "yard-40", both)
    table = f"FROM {live(filled, small_model).table} WHERE"
    assert sum(table in one for one in statements) == 1
    assert answer.per_map is not None
    assert sum(one.counts.compared for one in answer.per_map.values()) == 500
    few = ask(filled, "hall-11", both, filter={"session": ["r"]}, k=10)
    assert found(few) == nearest(places, "hall-11", both, 10, step=10)
    assert (few.counts.passed, few.counts.compared, few.exact) == (159, 159, True)
    known = {"exclude_frames": [f"hall-{i}" for i in range(1, 881)]}
    left = ask(filled, "hall-900", filter=known, k=10)
    after = [one for one in nearest(places, "hall-900", ["hall"], 900) if int(one[0][5:]) > 880]
    assert found(left) == after[:10]
    # and where the filter leaves more than a shortlist, the shortlist is of these
    many = ask(filled, "hall-3", both, filter={"exclude_frames": ["hall-4", "hall-2"]}, k=10)
    assert (many.counts.passed, many.exact) == (1597, False)
    wanted = [one for one in nearest(places, "hall-3", both, 12) if one[0] not in
              ("hall-4", "hall-2")]  # fmt: skip
    assert found(many) == wanted[:10]


def test_all_maps_of_a_fleet_are_asked_at_once_where_the_database_has_codes(
    filled: Engine, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(querying, "MOST_MAPS", 1)
    everywhere = SeveralQuery(maps="*")
    with pytest.raises(InvalidRequest, match="There are 2 maps, and 1 can be asked at once"):
        filled.queries.maps_of(everywhere)
    code_all(filled)
    assert filled.queries.maps_of(everywhere) == ["hall", "yard"]
    assert filled.queries.maps_of(everywhere, lambda name: name == "yard") == ["yard"]
    with pytest.raises(InvalidRequest, match="1 can be asked"):
        make("b", "local").queries.maps_of(everywhere)


def test_a_frame_deleted_during_the_search_or_before_is_not_found_afterwards(
    filled: Engine, places: dict[str, Bytes], small_model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    code_all(filled)
    before = ask(filled, "hall-100")
    gone, proposed = before.matches[0].frame_id, graphs.nearest
    assert len(filled._readers.choosing.remembered) == 500

    def late(*given: Any) -> Any:
        monkeypatch.setattr(graphs, "nearest", proposed)
        chosen = proposed(*given)
        filled.delete_frame("hall", gone)
        return chosen

    monkeypatch.setattr(graphs, "nearest", late)
    during = ask(filled, "hall-100")  # of the state before: its signature is remembered
    assert {gone, *found_ids(during)} == {gone, *found_ids(before)}
    after = ask(filled, "hall-100")
    wanted = [one for one in nearest(places, "hall-100", ["hall"], 51) if one[0] != gone]
    assert found(after)[:10] == wanted[:10]
    assert after.counts.map == SIZES["hall"] - 2  # itself, too
    with filled.store.database.read() as connection:
        row = find_map(connection, "hall")
        number = connection.execute(
            select(frames.c.number).where(frames.c.map_number == row.number, frames.c.id == gone)
        ).scalar_one()
    fit = live(filled, small_model)
    assert number not in coded(filled, fit)
    filled.delete_map("yard")
    assert len(coded(filled, fit)) == SIZES["hall"] - 1


def found_ids(answer: Answer) -> list[str]:
    return [one.frame_id for one in answer.matches]


def test_a_refit_goes_on_beside_queries_and_every_answer_is_right(
    filled: Engine, make: Make, places: dict[str, Bytes], small_model: Model,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    code_all(filled)
    first = live(filled, small_model)
    assert (first.fitted_on, len(coded(filled, first))) == (1600, 1600)
    # as many again, of which the old fit has never seen the like
    more = walk(1700, small_model.signature_bytes, seed=7, walks=2)
    fill(filled.store.database, "hall", small_model, more)
    grown = places | {"hall": np.concatenate([places["hall"], more])}
    monkeypatch.setattr(coding, "STEP_S", 0.0)  # a block in each turn
    monkeypatch.setattr(coding, "COUNT_S", 0.0)
    asked, steps = [], 0
    while True:
        filled._coding.run()
        frame = f"hall-{50 + 61 * steps % 2500}"
        wanted = nearest(grown, frame, ["hall", "yard"], 10)
        assert recall([ask(filled, frame, ["hall", "yard"])], [wanted]) == 1.0
        asked.append(live(filled, small_model).number)
        steps += 1
        if asked[-1] != first.number:
            break
        assert steps < 40
    assert steps > 10  # 3300 frames in blocks of 256
    second = live(filled, small_model)
    assert (second.fitted_on, len(coded(filled, second))) == (3300, 3300)
    assert second.code_id != first.code_id
    # whoever began to read the old table may end; then it goes
    assert len(coded(filled, first)) >= 1600
    monkeypatch.setattr(fits, "KEPT_S", 0.0)
    filled._coding.run()
    with filled.store.database.read() as connection:
        assert [fit.number for fit in fits.list_fits(connection)] == [second.number]


def test_frames_are_deleted_while_the_codes_of_a_refit_are_linked(
    filled: Engine, small_model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(graphs, "GRAPH_FROM", 100)
    code_all(filled)  # whose own turn is not waited for
    database, fit = filled.store.database, live(filled, small_model)
    with database.write() as connection:
        connection.execute(text(f"DROP INDEX {fit.graph}"))
    with database.read() as connection:
        codes_before = coded(filled, fit)
        row = find_map(connection, "hall")
        frame = find_frame(connection, row, "hall-7")
    linking = threading.Thread(target=graphs.add_graph_beside, args=(database, fit))
    with database.write(turn=False) as connection:  # which is waited for
        connection.execute(text(f"UPDATE {fit.table} SET code = code WHERE frame_number = 1"))
        linking.start()
        with database.write(turn=False) as looking:
            waits = text("SELECT count(*) FROM pg_stat_activity WHERE wait_event_type = 'Lock'")
            while not looking.execute(waits).scalar_one():
                pass
        filled.delete_frame("hall", "hall-7")
    linking.join()
    assert coded(filled, fit) == codes_before - {frame.number}
    monkeypatch.setattr(graphs, "_STEP_COST", 0.0)
    with database.read() as connection:
        assert graphs._by_graph(connection, fit, 500, 1600)
        # what reads the codes, such as a backup, keeps them, and costs nobody his turn for long
        codes.count_codes(connection, fit)
        with pytest.raises(StoreLocked), database.write() as writing:
            fits.drop_fit(writing, fit.number)
    with database.write() as connection:
        fits.drop_fit(connection, fit.number)
        assert fits.list_fits(connection) == []


def test_codes_that_are_lost_are_made_again_and_nobody_misses_a_frame(
    filled: Engine, places: dict[str, Bytes], small_model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    code_all(filled)
    fit = live(filled, small_model)
    wanted = nearest(places, "hall-500", ["hall"], 10)
    with filled.store.database.write() as connection:  # the nearest have none any more
        connection.execute(text(f"DELETE FROM {fit.table} WHERE frame_number % 3 = 0"))
    monkeypatch.setattr(coding, "CHECK_S", 0.0)
    while filled._coding.run():
        pass
    assert len(coded(filled, fit)) == 1600
    with filled.store.database.write() as connection:
        connection.execute(text(f"DROP TABLE {fit.table}"))
    local = ask(filled, "hall-500", k=10)  # by this node, as there is nothing to ask
    assert (found(local), local.exact, local.counts.compared) == (wanted, True, 899)
    code_all(filled)
    again = live(filled, small_model)
    assert again.number > fit.number
    assert len(coded(filled, again)) == 1600
    far = ask(filled, "hall-500", k=10)
    assert (found(far), far.exact, far.counts.compared) == (wanted, False, 500)


def test_frames_without_a_code_are_compared_and_new_ones_have_theirs_at_once(
    filled: Engine, small_model: Model
) -> None:
    code_all(filled)
    fit = live(filled, small_model)
    twin = walk(3, small_model.signature_bytes, seed=9)[2]
    names = fill(filled.store.database, "hall", small_model, np.stack([twin, twin]))
    answer = ask(filled, names[0], k=1)
    assert found(answer) == [(names[1], 0)]
    assert (answer.counts.compared, answer.exact) == (501, False)  # the other beside the shortlist
    # as a worker stores them: with the signature, if the fit is still the one that is asked
    database, choosing_of = filled.store.database, filled._readers.choosing
    made = StoredSignature(small_model.id, twin.tobytes(), "0" * 64, [1], [1])
    with database.read() as connection:
        frame = find_frame(connection, find_map(connection, "hall"), names[0])
    assert frame.number not in coded(filled, fit)
    code = choosing_of.coded(database, small_model.id, made.vector)
    with database.write() as connection:
        replace_signature(connection, frame, made)
        choosing_of.keep(connection, frame.number, code, anew=True)
    assert frame.number in coded(filled, fit)
    with database.write() as connection:
        choosing_of.keep(connection, frame.number, None, anew=True)
    assert frame.number not in coded(filled, fit)
    code_all(filled)
    assert len(coded(filled, fit)) == 1602
    assert ask(filled, names[0], k=1).counts.compared == 500


def test_a_node_asks_the_database_only_for_what_it_has_not(
    filled: Engine, make: Make, places: dict[str, Bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    code_all(filled)
    wanted = nearest(places, "hall-321", ["hall"], 10)
    node = make("b", "auto", tail_frames=1)
    for module in (readers, searching):
        monkeypatch.setattr(module, "WHOLE", 600)
    far = ask(node, "hall-321", k=10)
    assert (found(far), far.index_generation, far.counts.compared) == (wanted, 0, 500)
    node.publish_due()
    near = ask(node, "hall-321", k=10)
    assert (found(near), near.index_generation, near.counts.compared) == (wanted, 1, 500)
    with filled.store.database.read() as connection:
        rows = [find_map(connection, name) for name in SIZES]
        views = node._readers.views(connection, node.store.database, rows)
    assert [view.kind for view in views] == ["local", "local"]


def test_a_damaged_signature_costs_its_frame_alone(filled: Engine, small_model: Model) -> None:
    code_all(filled)
    before = ask(filled, "hall-77", k=10)
    hurt = before.matches[1].frame_id
    with filled.store.database.write() as connection:
        number = find_frame(connection, find_map(connection, "hall"), hurt).number
        own = signatures.c.frame_number == number
        connection.execute(signatures.update().where(own).values(checksum=1))
    after = ask(filled, "hall-77", k=9)
    assert found(after) == [one for one in found(before) if one[0] != hurt]
    with filled.store.database.read() as connection:
        view = filled._readers.views(
            connection, filled.store.database, [find_map(connection, "hall")]
        )[0]
    assert isinstance(view, stored.Stored)
    query = walk(1, small_model.signature_bytes, seed=0)[0]
    view.search(query, 899, dead=frozenset(), exact=True)
    assert view.damaged == {number}


def test_why_a_frame_is_not_found_names_the_shortlist(filled: Engine) -> None:
    code_all(filled)

    def explained(**more: Any) -> ExplainedFrame:
        told = ask(filled, "hall-1", **more).explained_frame
        assert told is not None
        return told

    rank, told = (explained(exact=exact, explain_frame="hall-450") for exact in (True, False))
    assert (told.rank, told.distance, rank.shortlisted) == (rank.rank, rank.distance, True)
    each = [explained(explain_frame=f"hall-{i}") for i in range(300, 600, 50)]
    missed = [one for one in each if not one.shortlisted]
    assert missed
    for one in missed:
        assert one.lost_at == "shortlist"
        assert one.reason.startswith("pgvector in the database did not propose it, though it has")


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
    assert filled._coding.run() == 0
    assert "no shortlist in the database: the extension `vector` cannot be made" in caplog.text
    answer = ask(filled, "hall-7", k=10)
    assert found(answer) == nearest(places, "hall-7", ["hall"], 10)
    assert (answer.exact, answer.counts.compared) == (True, 899)


def test_remembered_signatures_are_forgotten_in_time_and_kept_within_bounds() -> None:
    from sceneprint.engine.remembered import Remembered
    from sceneprint.store.vectors import Head

    heads = [Head(i, 1, 10 + i) for i in range(5)]
    few = Remembered(3600, most_bytes=30)
    few.put({head: bytes(10) for head in heads}, "m")
    assert (len(few), few.bytes_held) == (3, 30)
    assert sorted(few.get(heads, "m")) == [2, 3, 4]
    assert few.get([Head(4, 1, 0)], "m") == {}  # signed again since
    assert few.get(heads, "n") == {}
    few.put({Head(4, 1, 99): bytes(4)}, "m")
    assert (few.get([Head(4, 1, 99)], "m"), few.bytes_held) == ({4: bytes(4)}, 24)
    none = Remembered(0)
    none.put({heads[0]: bytes(10)}, "m")
    none.tidy()
    assert (len(none), none.bytes_held) == (0, 0)
