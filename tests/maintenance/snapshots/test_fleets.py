"""Snapshots of an embedded store put into a fleet's, and back: the same rows, the same answers."""

from __future__ import annotations

from pathlib import Path

from pydantic import SecretStr

from benchmarks.fleet.postgres import Server
from sceneprint.engine import Engine
from sceneprint.maintenance.fleets import restore_to_fleet
from sceneprint.maintenance.restoring import restore_snapshot
from sceneprint.maintenance.snapshots import take_snapshot
from sceneprint.schemas import Query
from sceneprint.settings import Settings

SIGNED = 4


def fleet_of(folder: Path, url: str) -> Settings:
    return Settings(data_dir=folder, database_url=SecretStr(url), index_dir=None)


def answers_of(settings: Settings, asked: list) -> list:
    """What the map `hall` answers, but for what no two answers share."""
    free = {"query_id": "", "milliseconds": {}}
    with Engine(settings) as engine:
        return [
            engine.query_upload("hall", one.data, one.meta, Query(exact=True)).model_copy(
                update=free
            )
            for one in asked
        ]


def inserted(sql: str) -> list[str]:
    """Rows of a dump; constraints within a table are in the order of whoever made it."""
    return [line for line in sql.splitlines() if line.startswith("INSERT")]


def test_there_and_back(archive, master, uploads, postgres: Server, tmp_path, content, settings):
    fleet = fleet_of(tmp_path / "fleet", postgres.create("there"))
    told = restore_to_fleet(archive, fleet)
    assert told.manifest.frames["indexed"] == SIGNED
    asked = uploads[: SIGNED + 2]
    before = answers_of(settings(master), asked)
    assert all(one.matches for one in before)
    assert answers_of(fleet, asked) == before
    back = take_snapshot(fleet, tmp_path / "back.tar")
    assert back.manifest.frames == told.manifest.frames
    restore_snapshot(tmp_path / "back.tar", tmp_path / "home")
    restore_snapshot(archive, tmp_path / "straight")
    wanted, found = content(tmp_path / "straight"), content(tmp_path / "home")
    assert inserted(found.pop("")) == inserted(wanted.pop(""))
    assert found == wanted
