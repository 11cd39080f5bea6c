"""Tests of `sceneprint doctor` with PostgreSQL and object stores."""

from pathlib import Path

import pytest
from pydantic import SecretStr

from sceneprint.cli.checks import Check, store_check
from sceneprint.cli.doctor import database, object_stores, server
from sceneprint.settings import Settings
from tests.whole_engine import Engine


def found_in(url, **other):
    settings = Settings(data_dir=Path("/nowhere"), database_url=SecretStr(url), **other)
    found = [database(settings), *server(settings), *object_stores(settings)]
    return {one.subject: one for one in found}


def test_a_service_does_not_take_the_server_for_a_file(postgres_url, tmp_path):
    settings = Settings(data_dir=tmp_path, database_url=SecretStr(postgres_url))
    with Engine(settings) as engine:
        stats = engine.statistics.collect(1)
    assert stats.bytes.database is not None
    size = f"{stats.bytes.database / 1e6:.1f}"
    text = f"database of {size} MB, blobs of 0.0 MB, indexes of 0.0 MB"
    assert store_check(stats) == Check("ok", "store", text)


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("postgresql://me:hidden@127.0.0.1:1/maps", "postgresql://me@127.0.0.1:1/maps: "),
        ("mysql://me:hidden@host/maps", "'mysql' is not a supported database"),
    ],
)
def test_a_server_that_cannot_be_asked(url, said):
    found = database(Settings(data_dir=Path("/nowhere"), database_url=SecretStr(url)))
    assert (found.verdict, found.subject) == ("WRONG", "database")
    assert said in found.text
    assert "hidden" not in found.text


def test_object_stores(bucket, tmp_path, monkeypatch):
    settings = Settings(
        data_dir=tmp_path, database_url=None, blob_url=SecretStr(f"{bucket}/blobs"),
        index_url=f"file://{tmp_path}/kept",
    )  # fmt: skip
    blobs, indexes = object_stores(settings)
    assert (blobs.verdict, indexes.verdict) == ("ok", "ok")
    assert blobs.text.startswith(f"{bucket}/blobs: written, read and deleted in ")
    assert "AWS_... in the environment" in blobs.text
    assert not any(path.is_file() for path in tmp_path.rglob("*"))
    lost = Settings(data_dir=tmp_path, database_url=None, index_url=f"{bucket}-none")
    [found] = object_stores(lost)
    assert (found.verdict, found.subject) == ("WRONG", "indexes")
