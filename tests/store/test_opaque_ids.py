"""Tests of opaque ids, which only their store can decode and which reveal nothing."""

from contextlib import ExitStack

import pytest

from sceneprint.store import open_store
from sceneprint.store.opaque_ids import START


@pytest.fixture
def opened():
    """The seals of a new or a known store; all are closed at the end."""
    with ExitStack() as stack:

        def opened(folder):
            store = open_store(f"sqlite:///{folder / 'sceneprint.db'}", folder / "blobs")
            stack.callback(store.database.close)
            return store.seals

        yield opened


def test_a_seal_is_read_by_its_store_in_every_process(opened, tmp_path):
    (tmp_path / "other").mkdir()
    mine, again, other = opened(tmp_path), opened(tmp_path), opened(tmp_path / "other")
    for number in (1, 2, 255, 256, 2**31, 2**63 - 1):
        seal = mine.seal("event", number)
        assert again.seal("event", number) == seal
        assert again.open("event", seal) == number
        assert mine.open("job", seal) is None
        assert other.open("event", seal) is None
        assert other.seal("event", number) != seal
        assert mine.seal("job", number) != seal
    assert mine.seal("event", 0) == START
    assert mine.open("event", START) == 0


def test_what_was_not_given_out_is_none(opened, tmp_path):
    seals = opened(tmp_path)
    seal = seals.seal("frame", 7)
    for place in range(48):  # whichever digit is another
        altered = f"{seal[:place]}{'0' if seal[place] != '0' else '1'}{seal[place + 1 :]}"
        assert seals.open("frame", altered) is None
    for wrong in ("", "7", "00", "x" * 32, seal.upper() + "a", seal + "0", seal[:-1], "0" * 48):
        assert seals.open("frame", wrong) is None
