"""Tests of `sceneprint doctor` with PostgreSQL and object stores."""

from pathlib import Path

import pytest
from pydantic import SecretStr

from sceneprint.cli.doctor import database, object_stores, server
from sceneprint.settings import Settings


def found_in(url, **other):
    settings = Settings(data_dir=Path("/nowhere"), database_url=SecretStr(url), **other)
    found = [database(settings), *server(settings), *object_stores(settings)]
    return {one.subject: one for one in found}


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
