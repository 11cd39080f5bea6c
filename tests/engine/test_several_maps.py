"""Tests of a query over several maps with a common ranking."""

import numpy as np
import pytest

from sceneprint.engine.ingest.uploads import Upload
from sceneprint.errors import InvalidRequest, UnknownFrame, UnknownMap
from sceneprint_client.api import NamedFrame, NewMap, Query, SeveralQuery

MAPS = ["hall", "lab"]


@pytest.fixture
def two(full, uploads):
    """`hall` with all twelve frames, and `lab` with two of each room."""
    full.create_map(NewMap(name="lab", model="depth"))
    for i in (1, 4, 7, 10):
        full.add(uploads[i], "lab")
    full.work_off()
    return full


def names_of(engine, name):
    return [frame.frame_id for frame in engine.list_frames(name).items]


def ask(engine, maps, upload, **how):
    query = Query.model_validate({"keep": False, **how})
    return engine.queries.upload(maps, upload.data, upload.meta, query)


def test_the_ranking_is_that_of_both_maps_together(two, uploads):
    how = {"stages": ["retrieve"], "k": 50}
    alone = {name: ask(two, [name], uploads[1], **how) for name in MAPS}
    both = ask(two, MAPS, uploads[1], **how)
    listed = [(match.distance, match.map, match.frame_id, match.similarity)
              for name in MAPS for match in alone[name].matches]  # fmt: skip
    actual = [(m.distance, m.map, m.frame_id, m.similarity) for m in both.matches]
    assert sorted(actual) == sorted(listed)
    assert [match.distance for match in both.matches] == sorted(match[0] for match in listed)
    assert [(match.distance, match.map) for match in both.matches[:2]] == [(0, "hall"), (0, "lab")]
    assert (both.maps, both.per_map.keys()) == (MAPS, set(MAPS))
    assert {name: part.counts for name, part in both.per_map.items()} == {
        name: one.counts for name, one in alone.items()
    }
    for field in ("map", "passed", "compared", "ranked"):
        assert getattr(both.counts, field) == 16
    other_way = ask(two, MAPS[::-1], uploads[1], **how)
    assert other_way.matches == both.matches
    only = ask(two, MAPS, uploads[1], filter={"exclude_frames": names_of(two, "hall")}, **how)
    assert {match.map for match in only.matches} == {"lab"}
    assert (only.counts.passed, only.per_map["hall"].counts.passed) == (4, 0)


def test_a_pose_is_of_one_map(two, uploads):
    both = ask(two, MAPS, uploads[8], k=50, candidates=50, stages=["retrieve", "validate"])
    accepted = [match for match in both.matches if match.validation.status == "accepted"]
    counts = {name: sum(match.map == name for match in accepted) for name in MAPS}
    assert min(counts.values()) >= 1
    assert {name: part.counts.accepted for name, part in both.per_map.items()} == counts
    assert both.counts.accepted == sum(counts.values())
    # both maps call the parent frame the same, and still only the one with most strong votes
    assert {match.pose_in_map.parent_frame for match in accepted} == {uploads[8].room}
    assert both.location.map == "hall"
    off = np.array(both.location.pose.matrix)[:3, 3] - uploads[8].pose[:3, 3]
    assert np.linalg.norm(off) < 0.03
    diverse = ask(two, MAPS, uploads[8])
    assert diverse.counts.selected == 10 == len(diverse.matches)
    assert sum(part.counts.selected for part in diverse.per_map.values()) == 10
    assert diverse.matches[0].rank == 1


def test_a_stored_frame_does_not_find_itself_and_finds_others(two):
    own = two.ids()[4]
    query = Query(stages=("retrieve",), k=50, keep=False)
    both = two.queries.stored(MAPS, NamedFrame(map="hall", frame_id=own), query)
    assert own not in [match.frame_id for match in both.matches]
    assert (both.counts.map, len(both.matches)) == (15, 15)
    assert (both.matches[0].distance, both.matches[0].map) == (0, "lab")
    assert (both.frame.map, both.frame.frame_id) == ("hall", own)
    away = two.queries.stored(["lab"], NamedFrame(map="hall", frame_id=own), query)
    assert (away.maps, away.counts.map, away.per_map) == (["lab"], 4, None)
    explain = query.model_copy(update={"explain_frame": names_of(two, "lab")[2]})
    answer = two.queries.stored(MAPS, NamedFrame(map="hall", frame_id=own), explain)
    rank = next(match.rank for match in both.matches if match.frame_id == explain.explain_frame)
    assert (answer.explained_frame.map, answer.explained_frame.rank) == ("lab", rank)
    assert answer.explained_frame.of == 15
    with pytest.raises(UnknownFrame):
        two.queries.stored(["lab"], NamedFrame(map="lab", frame_id=own), query)


def test_two_maps_may_call_their_frames_alike(full, uploads):
    maps = ["attic", "cellar"]
    for name, places in zip(maps, ((0, 1), (1, 2)), strict=True):
        full.create_map(NewMap(name=name, model="depth"))
        for frame_id, i in zip(("a", "b"), places, strict=True):
            upload = Upload(uploads[i].data, uploads[i].meta, frame_id=frame_id)
            full.uploads.add(name, upload)
    full.work_off()

    def located(of, **how):
        return full.queries.stored(of, NamedFrame(map="attic", frame_id="b"), Query(**how))

    several = located(maps)
    first = several.matches[0]
    assert (first.map, first.frame_id, first.distance) == ("cellar", "a", 0)
    for match in several.matches:
        ends = match.transform.parent_frame, match.transform.child_frame
        assert ends == (f"{match.frame_id}.optical", "query.optical")
    same = next(m for m in several.matches if (m.map, m.frame_id) == ("cellar", "b"))
    details = full.inspection.match(several.query_id, "b", "cellar")
    assert details.transform == same.transform
    assert b"comment frame query.optical" in full.inspection.cloud(several.query_id)
    assert located(["cellar"]).location.pose.child_frame == "query.optical"
    assert located(["attic"]).location.pose.child_frame == "b.optical"
    answer = located(maps, explain_frame="b", keep=False).explained_frame
    assert (answer.map, answer.lost_at, answer.rank) == ("cellar", None, same.rank)
    assert answer.transform == same.transform
    full.delete_frame("attic", "a")
    assert located(maps, explain_frame="a", keep=False).explained_frame.map == "cellar"


def test_maps_of_two_models_are_not_asked_as_one(two, uploads):
    two.create_map(NewMap(name="big", model="paper"))
    with pytest.raises(InvalidRequest, match=r"hall has depth-.*big has paper-") as caught:
        ask(two, ["hall", "big"], uploads[0])
    assert [field for field, _ in caught.value.fields] == ["maps.hall", "maps.big"]
    stored = NamedFrame(map="hall", frame_id=two.ids()[0])
    with pytest.raises(InvalidRequest, match=r"big has paper-.*hall has depth-"):
        two.queries.stored(["big"], stored, Query())
    with pytest.raises(UnknownMap, match="'attic'"):
        ask(two, ["hall", "attic"], uploads[0])


def test_maps_are_chosen_by_who_asks(two):
    def of(maps, *may):
        return two.queries.maps_of(SeveralQuery.model_validate({"maps": maps}), may.__contains__)

    assert of("*", "lab", "hall") == ["hall", "lab"]
    assert of("*", "lab") == ["lab"]
    assert of("lab, hall,lab", "lab", "hall") == ["lab", "hall"]
    for maps, may in ((["hall", "lab"], ["hall"]), (["hall", "attic"], ["hall", "attic"])):
        with pytest.raises(UnknownMap) as caught:
            two.queries.upload(of(maps, *may), b"", None, Query())
        assert str(caught.value).startswith(f"There is no map {maps[1]!r}.")
    with pytest.raises(UnknownMap, match="no map to search"):
        of("*")
    for i in range(63):
        two.create_map(NewMap(name=f"m{i}", model="depth"))
    with pytest.raises(InvalidRequest, match="65 maps, but a query can search at most 64"):
        of("*", "hall", "lab", *(f"m{i}" for i in range(63)))
