"""Tests of queries, comparisons and their records."""

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import UnknownFrame, UnknownMap, UnknownQuery
from sceneprint_client.api import NamedFrame, ValidationOptions


def test_all_ways_of_asking(client, map_name, references):
    """One after the other: options, maps as one, a pose, and two frames compared."""
    other = f"{map_name}-b"
    client.create_map(map_name)
    ids = [client.upload(map_name, r, wait_s=PATIENCE_S).frame_id for r in references]
    client.create_map(other)
    added = client.upload(other, references[1], wait_s=PATIENCE_S).frame_id
    options = {
        "k": 2, "seed": 3, "candidates": 4, "diversity": {"omega": 8.0},
        "validation": ValidationOptions(strong=1.0), "explain": True, "keep": False,
        "filter": {"exclude_frames": [ids[4]]}, "stages": "retrieve,diversify,validate",
    }  # fmt: skip
    assert len(client.query(map_name, references[1], **options).explanations) == 5
    several = client.query(maps=[map_name, other], frame=references[1], **options)
    assert several.maps == [map_name, other]
    stored = client.query(map_name, frame_id=ids[1], maps=f"{other},{map_name}")
    assert (stored.matches[0].map, stored.matches[0].distance) == (other, 0)
    answer = client.localize(map_name, references[0], seed=2, robot="spot")
    assert (answer.pose.parent_frame, answer.seed) == ("room-0/seq-01", 2)
    named = client.similarity((map_name, ids[0]), (other, added), seed=1)
    sent = client.similarity(NamedFrame(map=other, frame_id=added), references[0])
    assert sent.distance == named.distance > 0
    bare = client.similarity(references[0], references[1], validate=False, model="depth")
    assert bare.validation is None
    # each query left a record, the newest first; the comparisons left none
    assert next(client.queries(map_name)).query_id == answer.query_id
    assert next(client.queries(other)).query_id == stored.query_id  # where its match is
    (spot,) = client.queries(map_name, robot="spot", status=["found", "failed"])
    assert (spot.query_id, spot.session, spot.key) == (answer.query_id, "room-0/seq-01", None)
    assert list(client.queries(map_name, robot="spot", until=spot.at)) == []
    client.delete_queries(map_name)
    assert list(client.queries(map_name)) == []


def test_what_cannot_be_asked_is_refused(client, map_name, references):
    client.create_map(map_name)
    frame = references[0]
    with pytest.raises(UnknownMap, match="'nowhere'"):
        client.query(maps=[map_name, "nowhere"], frame=frame)
    with pytest.raises(UnknownFrame):
        client.similarity(frame, (map_name, "nobody"))
    for wrong in (
        {"frame": frame}, {"maps": "*"}, {"maps": "*", "map_name": map_name, "frame": frame},
        {"maps": "*", "frame_id": "x"}, {"map_name": map_name, "frame": frame, "speed": 1},
    ):  # fmt: skip
        with pytest.raises(TypeError):
            client.query(**wrong)


def test_what_an_answer_rests_on(client, map_name, references):
    client.create_map(map_name)
    added = [client.upload(map_name, reference, wait_s=60) for reference in references[:2]]
    answer = client.query(map_name, references[1], k=2, seed=3)
    assert client.answer(answer.query_id) == answer
    best = answer.matches[0].frame_id
    assert best == added[1].frame_id
    details = client.match_details(answer.query_id, best, map_name)
    assert details.validation == answer.matches[0].validation
    overlay = client.overlay(answer.query_id, best, color="residual")
    assert f"comment frame {best}.optical\n".encode() in overlay
    assert client.query_cloud(answer.query_id).startswith(b"ply\n")
    assert client.similarities(answer.query_id).similarity[0][1] == 1.0  # the query is the frame
    for call in (client.answer, client.query_cloud, client.similarities):
        for wrong in ("0" * 32, "..", "", "a/b"):
            with pytest.raises(UnknownQuery):
                call(wrong)
