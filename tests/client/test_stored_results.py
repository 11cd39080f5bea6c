"""Tests of stored results of a query through the client."""

from __future__ import annotations

import pytest

from sceneprint.errors import InvalidRequest, NotIndexed, UnknownFrame, UnknownQuery
from sceneprint.formats.dataset import FrameReference
from sceneprint_client import Client


def test_what_an_answer_rests_on(
    client: Client, map_name: str, references: tuple[FrameReference, ...]
) -> None:
    client.create_map(map_name)
    added = [client.upload(map_name, one, wait_s=60) for one in references[:2]]
    answer = client.query(map_name, references[1], k=2, seed=3)
    assert client.answer(answer.query_id) == answer
    best = answer.matches[0].frame_id
    assert best == added[1].frame_id
    details = client.match_details(answer.query_id, best, map_name)
    assert details.validation == answer.matches[0].validation
    overlay = client.overlay(answer.query_id, best, color="residual")
    assert f"comment frame {best}.optical\n".encode() in overlay
    assert client.query_cloud(answer.query_id).startswith(b"ply\n")
    alike = client.similarities(answer.query_id).similarity
    assert [len(row) for row in alike] == [3, 3, 3]
    assert alike[0][1] == 1.0  # the query is the frame
    bare = client.query(map_name, references[1], stages=("retrieve",))
    with pytest.raises(NotIndexed):
        client.query_cloud(bare.query_id)
    for call in (client.answer, client.query_cloud, client.similarities):
        for wrong in ("0" * 32, "..", "", "a/b"):
            with pytest.raises(UnknownQuery):
                call(wrong)
    with pytest.raises(UnknownFrame):
        client.match_details(answer.query_id, "nobody")
    for how in ({"color": "pink"}, {"transform": "best"}):
        with pytest.raises(InvalidRequest, match=next(iter(how))):
            client.overlay(answer.query_id, best, **how)  # type: ignore[arg-type]
    with pytest.raises(InvalidRequest, match="limit"):
        client.similarities(answer.query_id, 0)
