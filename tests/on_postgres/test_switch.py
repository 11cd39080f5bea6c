"""Tests of the switch to PostgreSQL: one database for each data folder."""

import os
import shutil

import pytest

from sceneprint.settings import Settings
from sceneprint_client.api import NewMap
from tests.whole_engine import Engine

pytestmark = pytest.mark.skipif(
    os.environ.get("SCENEPRINT_TEST_DATABASE") != "postgresql", reason="make test-postgres"
)


def test_a_folder_has_a_database_and_its_copy_a_copy(tmp_path):
    first, copy = (Settings(data_dir=tmp_path / name, database_url=None) for name in ("a", "b"))
    with Engine(first) as engine:
        assert engine.store.database.dialect == "postgresql"
        engine.create_map(NewMap(name="hall", model="depth"))
    shutil.copytree(first.data_dir, copy.data_dir)
    with Engine(copy) as engine:
        engine.create_map(NewMap(name="attic", model="depth"))
        assert [one.name for one in engine.list_maps()] == ["attic", "hall"]
    with Engine(first) as engine:
        assert [one.name for one in engine.list_maps()] == ["hall"]
    assert [path.name for path in tmp_path.rglob("*.db")] == []
