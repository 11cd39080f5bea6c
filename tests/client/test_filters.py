"""Filters and `if_novel` through the client."""

from __future__ import annotations

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import InvalidRequest
from sceneprint.formats.dataset import FrameReference
from sceneprint_client import Client, meta_of
from sceneprint_client.api import Filter, FrameState, JobState

References = tuple[FrameReference, ...]


def test_only_what_passes_is_searched(
    client: Client, map_name: str, references: References
) -> None:
    client.create_map(map_name, model="depth")
    added = [
        client.upload(
            map_name, one, meta_of(one, robot=f"r{i % 2}", tags=[f"t{i}"]), wait_s=PATIENCE_S
        )
        for i, one in enumerate(references)
    ]
    ids = [one.frame_id for one in added]
    asked = references[0]
    everything = client.query(map_name, asked, stages=["retrieve"], k=50)
    assert everything.counts.map == everything.counts.passed == len(ids)
    for wanted in (Filter(robot=["r1"]), {"robot": "r1"}, {"exclude_frames": ids[::2]}):
        answer = client.query(map_name, asked, stages=["retrieve"], k=50, filter=wanted)
        assert {match.frame_id for match in answer.matches} == set(ids[1::2])
        assert (answer.counts.map, answer.counts.passed) == (len(ids), len(ids[1::2]))
        kept = [match.frame_id for match in everything.matches if match.frame_id in ids[1::2]]
        assert [match.frame_id for match in answer.matches] == kept
    by_id = client.query(map_name, frame_id=ids[0], stages=["retrieve"], filter={"tags": ["t1"]})
    assert [match.frame_id for match in by_id.matches] == [ids[1]]
    with pytest.raises(InvalidRequest, match="greater than 0") as told:
        client.query(map_name, asked, filter={"not_within_s": -1})
    assert [place for place, _ in told.value.fields] == ["filter.not_within_s"]
    with pytest.raises(InvalidRequest, match="no captured_at") as told:
        client.query(map_name, asked, filter={"not_within_s": 1.5})
    assert [place for place, _ in told.value.fields] == ["captured_at"]


def test_what_the_map_has_is_not_kept(
    client: Client, map_name: str, references: References
) -> None:
    client.create_map(map_name, model="depth")
    first = client.upload(map_name, references[0], wait_s=PATIENCE_S, if_novel=True)
    assert first.state is FrameState.INDEXED
    second = client.upload(map_name, references[1], wait_s=PATIENCE_S, if_novel=1.0)
    assert second.state is FrameState.REDUNDANT
    assert first.frame_id in str(second.reason)
    (job,) = client.wait([second.job_id], timeout_s=PATIENCE_S)
    assert job.state is JobState.SUCCEEDED
    assert client.map(map_name).frames == {"indexed": 1, "redundant": 1}
    kept = client.upload(map_name, references[1], wait_s=PATIENCE_S)
    assert (kept.state, kept.frame_id) == (FrameState.INDEXED, second.frame_id)
    with pytest.raises(InvalidRequest, match="above 0, up to 1"):
        client.upload(map_name, references[2], if_novel=0.0)
