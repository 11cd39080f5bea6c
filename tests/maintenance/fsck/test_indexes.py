"""Tests of damaged indexes, and of indexes that differ from the database."""

import pytest

from sceneprint_client.api import Query
from tests.whole_engine import Engine


@pytest.mark.parametrize("kind", ["keys", "faiss", "json"])
def test_a_damaged_index_is_removed_and_made_again(house, kind, truth, uploads):
    path = house.index_files(kind)[0]
    house.damage(path)
    (found,) = house.look(repair=True)
    assert (found.kind, found.path, found.done) == (
        "damaged-index", path.parent, "the index is removed"
    )  # fmt: skip
    assert [one.suffix for one in path.parent.iterdir() if one.name != ".lock"] == []
    assert house.look() == []
    assert house.answers(uploads[:12]) == truth
    with Engine(house.settings) as engine:
        engine.publish_due()
        ask = Query(stages=("retrieve",))
        answer = engine.queries.upload(["hall"], uploads[0].data, uploads[0].meta, ask)
    assert answer.index_version > 0
    assert house.look() == []
    assert house.answers(uploads[:12]) == truth


def test_an_index_that_differs_from_the_database_is_made_again(house, uploads):
    """All its checksums hold: it was made of other signatures."""
    house.sql(  # both frames have the signature of the second, with its checksum
        "UPDATE signatures SET (vector, checksum) = (SELECT vector, checksum FROM signatures"
        " WHERE frame_number = 2) WHERE frame_number = 1"
    )
    house.sql("UPDATE frames SET revision = 1 WHERE number = 14")  # of `attic`: no index there
    (found,) = house.look(repair=True)
    ((first,),) = house.sql("SELECT id FROM frames WHERE number = 1")
    assert (found.kind, found.left) == ("damaged-index", False)
    assert found.means == f"lacks the signatures of frames {first}"
    assert house.look() == []
    with Engine(house.settings) as engine:
        assert engine.publish_due() == 1
        query = Query(stages=("retrieve",), k=2)
        answer = engine.queries.upload(["hall"], uploads[1].data, uploads[1].meta, query)
    assert [match.distance for match in answer.matches] == [0, 0]
    assert answer.index_version == 1
    assert house.look() == []
