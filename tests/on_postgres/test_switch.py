"""Tests of the switch to PostgreSQL: one database for each data folder."""

import os
import shutil
import subprocess
import sys

import pytest

from sceneprint.settings import Settings
from sceneprint_client.api import NewMap
from tests.whole_engine import Engine

pytestmark = pytest.mark.skipif(
    os.environ.get("SCENEPRINT_TEST_DATABASE") != "postgresql", reason="make test-postgres"
)
#: Another process that names the maps of a folder.
CHILD = """
import sys
from pathlib import Path
from tests.whole_engine import Engine
from sceneprint.settings import Settings
with Engine(Settings(data_dir=Path(sys.argv[1]))) as engine:
    print(engine.store.database.dialect, *[one.name for one in engine.list_maps()])
"""


def opened(folder):
    return Engine(Settings(data_dir=folder, database_url=None))


def names(engine):
    return [one.name for one in engine.list_maps()]


def test_a_folder_has_a_database_and_its_copy_a_copy(tmp_path):
    first, copy = tmp_path / "first", tmp_path / "copy"
    with opened(first) as engine:
        assert engine.store.database.dialect == "postgresql"
        engine.create_map(NewMap(name="hall", model="depth"))
    shutil.copytree(first, copy)
    with opened(copy) as engine:
        assert names(engine) == ["hall"]
        engine.create_map(NewMap(name="attic", model="depth"))
    with opened(first) as engine, opened(tmp_path / "other") as other:
        assert (names(engine), names(other)) == (["hall"], [])
    told = subprocess.run(
        [sys.executable, "-c", CHILD, str(copy)], capture_output=True, text=True, check=True
    )
    assert told.stdout.split() == ["postgresql", "attic", "hall"]
    assert [path.name for path in tmp_path.rglob("*.db")] == []


def test_a_folder_that_was_removed_begins_anew(tmp_path):
    with opened(tmp_path / "data") as engine:
        engine.create_map(NewMap(name="hall", model="depth"))
    shutil.rmtree(tmp_path / "data")
    with opened(tmp_path / "data") as engine:
        assert names(engine) == []
