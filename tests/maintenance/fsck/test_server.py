"""Tests of the check and repair of a fleet's store on PostgreSQL."""

import pytest
from pydantic import SecretStr

from sceneprint.bundle.backup import take_backup
from sceneprint.bundle.restoration import restore_to_server
from sceneprint.errors import StoreAway
from sceneprint.maintenance.fsck.check import fsck
from sceneprint_client.api import JobState

pytestmark = pytest.mark.sqlite_only("these have servers of their own")

FIRST = "(SELECT MIN(number) FROM frames WHERE state = 'indexed')"
WAITING = "(SELECT MAX(number) FROM frames WHERE state = 'received')"


@pytest.fixture(scope="session")
def bundles(copied, tmp_path_factory):
    place = tmp_path_factory.mktemp("bundles")
    # of a copy: SQLite leaves an empty log beside what it has only read
    take_backup(copied(place / "house").settings, str(place / "bundles"))
    return str(place / "bundles")


@pytest.fixture
def fleet(bundles, master, house_at, postgres_url, tmp_path):
    made = house_at(tmp_path / "node", SecretStr(postgres_url), master.settings.cache_dir)
    restore_to_server(bundles, made.settings)
    return made


def test_rows_and_blobs_are_checked_and_mended(fleet):
    assert fleet.kinds() == fleet.kinds(quick=True) == []
    [(geometry,)] = fleet.sql(f"SELECT geometry FROM signatures WHERE frame_number = {FIRST} + 4")
    fleet.blob(geometry).write_bytes(b"other")
    for change in (
        f"UPDATE signatures SET vector = 'x' || substr(vector, 2) WHERE frame_number = {FIRST}",
        f"DELETE FROM signatures WHERE frame_number = {FIRST} + 1",
        f"UPDATE frames SET pose_x = pose_x + 1 WHERE number = {FIRST} + 2",
        f"DELETE FROM frame_tags WHERE frame_number = {FIRST} + 3",
        f"UPDATE jobs SET state = 'dead' WHERE frame_number = {WAITING}",
        "UPDATE maps SET revision = 11, used_bytes = used_bytes - 1 WHERE name = 'hall'",
    ):
        fleet.sql(change)
    wanted = [
        "damaged-artifact", "damaged-signature", "frame-without-job", "frame-without-signature",
        "revision-ahead", "stale-value", "stale-value", "stale-value",
    ]  # fmt: skip
    assert sorted(fleet.kinds()) == wanted
    repaired = fleet.look(repair=True)
    assert sorted(one.kind for one in repaired) == wanted
    assert [one.error for one in repaired if one.left] == []
    assert set(fleet.work()) == {JobState.SUCCEEDED}
    assert fleet.kinds() == []


def test_a_server_that_is_away_is_no_damage(fleet, postgres):
    fleet.sql("UPDATE maps SET used_bytes = used_bytes - 1 WHERE name = 'hall'")
    seen = fsck(fleet.settings)
    assert next(seen).kind == "stale-value"  # the next check finds the connections gone
    name = fleet.settings.database.rsplit("/")[-1]
    postgres.execute(f"ALTER DATABASE {name} ALLOW_CONNECTIONS false")
    postgres.execute(
        "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE application_name='sceneprint'"
    )
    with pytest.raises(StoreAway):
        list(seen)
