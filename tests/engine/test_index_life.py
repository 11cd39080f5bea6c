"""Tests of correct answers from an empty index to a damaged and rebuilt one."""

import random
from pathlib import Path

import numpy as np
import pytest

from sceneprint.engine.search import local_index
from sceneprint.engine.search.local_index import AppendBuffer
from sceneprint.errors import UnusableStore
from sceneprint.index.index_version import newest
from sceneprint.models import read_model
from sceneprint.store.signatures import SignatureChange
from sceneprint_client.api import Query
from tests.engine.conftest import flip

ALL = Query(stages=("retrieve",), k=50)
#: Bytes of a signature.
LENGTH = read_model("depth").signature_bytes
pytestmark = pytest.mark.usefixtures("_always_look")


def ask(engine, uploads):
    answer = engine.queries.upload(["hall"], uploads[2].data, uploads[2].meta, ALL)
    return [(match.frame_id, match.distance) for match in answer.matches], answer.index_version


def until_healed(engine):
    """Versions that upkeep publishes until a round of verifying is over."""
    published = 0
    for _ in range(20):
        published += engine.publish_due()
    return published


@pytest.mark.parametrize("kind", ["faiss", "keys", "json"])
def test_a_flipped_byte_of_an_index_is_found_and_healed(data, make_engine, uploads, kind):
    builder = make_engine(data, unindexed_frames=1, index_check_interval_s=1)
    served = make_engine(data)  # holds the index open all the time
    wanted, _ = ask(make_engine(data), uploads)
    assert builder.publish_due() == 1
    assert ask(served, uploads) == (wanted, 1)
    (path,) = data.glob(f"index/hall-*/*.{kind}")
    flip(path, random.Random(kind).randrange(path.stat().st_size))
    again = make_engine(data, unindexed_frames=1, index_check_interval_s=1)
    (data / "index" / ".scrubbed").unlink(missing_ok=True)  # it is time
    assert until_healed(again) == 1
    assert until_healed(again) == 0
    folder = next(data.glob("index/hall-*"))
    sound = newest(folder, served.get_map("hall").model_id, LENGTH)
    assert (sound.number, len(sound)) == (2, 12)
    for engine in (served, make_engine(data)):
        assert ask(engine, uploads) == (wanted, 2)


def test_a_frame_signed_anew_is_found_once_with_its_new_signature():
    tail = AppendBuffer(4, Path("unused"))
    tail.append(SignatureChange(7, "", 1, None), np.full(4, 1, np.uint8))
    tail.append(SignatureChange(8, "", 2, None), np.full(4, 2, np.uint8))
    handed_out = tail.tail()
    other = tail.copy(0, without={7})
    other.append(SignatureChange(7, "", 3, None), np.full(4, 3, np.uint8))
    assert (tail.revision_of(7), other.revision_of(7), other.revision_of(9)) == (1, 3, 0)
    np.testing.assert_array_equal(other.tail().keys, [8, 7])
    np.testing.assert_array_equal(other.tail().signatures[:, 0], [2, 3])
    np.testing.assert_array_equal(handed_out.signatures[:, 0], [1, 2])


@pytest.mark.parametrize("in_memory", [10**9, 0])
def test_a_tail_in_a_file_is_as_one_in_memory(tmp_path, monkeypatch, in_memory):
    monkeypatch.setattr(local_index, "IN_MEMORY", in_memory)
    rows = np.random.default_rng(3).integers(0, 256, (300, 50), np.uint8)
    tail, views = AppendBuffer(50, tmp_path / "index"), []
    for i, row in enumerate(rows):
        tail.append(SignatureChange(i, "", i + 1, None), row)
        if i % 50 == 0:
            views.append(tail.tail())
    assert tail.bytes_held == (512 * 50 if in_memory else 0)
    for n, view in zip(range(1, 300, 50), views, strict=True):
        np.testing.assert_array_equal(view.signatures, rows[:n])
        np.testing.assert_array_equal(view.keys, np.arange(n))
    late = tail.copy(200)
    np.testing.assert_array_equal(late.tail().signatures, rows[200:])
    np.testing.assert_array_equal(late.tail().keys, np.arange(200, 300))
    assert list(tmp_path.glob("index/*")) == []  # nothing to be left behind


def test_a_tail_that_finds_no_room_is_as_it_was(tmp_path, monkeypatch):
    tail, row = AppendBuffer(50, tmp_path), np.ones(50, np.uint8)
    for i in range(64):
        tail.append(SignatureChange(i, "", i + 1, None), row)

    def full(*_):
        raise UnusableStore("no room")

    with monkeypatch.context() as patch:
        patch.setattr(AppendBuffer, "_allocate", full)
        with pytest.raises(UnusableStore):
            tail.append(SignatureChange(64, "", 65, None), row)
    assert len(tail.tail()) == 64
    tail.append(SignatureChange(64, "", 65, None), row)  # there is room again
    np.testing.assert_array_equal(tail.tail().keys, np.arange(65))
