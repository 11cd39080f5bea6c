"""What is looked at after a query: the same from a service and in process."""

from __future__ import annotations

from typing import Any

import pytest

from sceneprint.client import Client
from sceneprint.datasets import FrameReference
from sceneprint.errors import InvalidRequest, NotIndexed, UnknownFrame, UnknownQuery


def test_both_tell_the_same(
    remote: Client, embedded: Client, map_name: str, references: tuple[FrameReference, ...]
) -> None:
    told: list[list[Any]] = []
    for client in (remote, embedded):
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
        same: dict[str, Any] = {"query_id": "", "frame_id": "", "transform": None, "rival": None}
        told.append(
            [
                client.query_cloud(answer.query_id).partition(b"end_header\n")[2],
                overlay.partition(b"end_header\n")[2],
                details.model_copy(update=same),
                client.similarities(answer.query_id).similarity,
                answer.matches[0].uncertainty,
            ]
        )
        bare = client.query(map_name, references[1], stages=("retrieve",))
        with pytest.raises(NotIndexed, match="without validation"):
            client.query_cloud(bare.query_id)
        for call in (client.answer, client.query_cloud, client.similarities):
            for wrong in ("0" * 32, "..", "", "a/b"):
                with pytest.raises(UnknownQuery):
                    call(wrong)
        with pytest.raises(UnknownFrame):
            client.match_details(answer.query_id, "nobody")
        for how in ({"color": "pink"}, {"transform": "best"}):
            with pytest.raises(InvalidRequest, match="Give one of"):
                client.overlay(answer.query_id, best, **how)  # type: ignore[arg-type]
        with pytest.raises(InvalidRequest, match="1 to 200"):
            client.similarities(answer.query_id, 0)
    assert told[0] == told[1]
    remote.delete_map(map_name)
