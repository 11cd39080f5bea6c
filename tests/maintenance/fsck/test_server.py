"""Tests of the check and repair of a fleet's store on PostgreSQL."""

import psycopg
import pytest
from pydantic import SecretStr

from sceneprint.bundle.backup import take_backup
from sceneprint.bundle.restoration import restore_to_server
from sceneprint.errors import StoreAway
from sceneprint.maintenance.fsck.check import fsck
from sceneprint.settings import Settings
from sceneprint_client.api import JobState
from tests.whole_engine import Engine

pytestmark = pytest.mark.sqlite_only("these have servers of their own")

FIRST = "(SELECT MIN(number) FROM frames WHERE state = 'indexed')"
WAITING = "(SELECT MAX(number) FROM frames WHERE state = 'received')"


class Fleet:
    """A store on PostgreSQL, and what happens to it."""

    def __init__(self, settings, url):
        self.settings, self._url = settings, url.replace("+psycopg", "")

    def sql(self, *asked):
        """Ask or change the database past all that would refuse it."""
        with psycopg.connect(self._url, autocommit=True) as connection:
            connection.execute("SET session_replication_role = replica")
            found = [connection.execute(one) for one in asked][-1]
            return found.fetchall() if found.description else []

    def look(self, **how):
        return list(fsck(self.settings, **how))

    def kinds(self, **how):
        return [one.kind for one in self.look(**how)]

    def work(self):
        with Engine(self.settings) as engine:
            states = set()
            while (claimed := engine.claim("w")) is not None:
                states.add(engine.run(claimed))
            return states


@pytest.fixture(scope="session")
def bundles(copied, tmp_path_factory):
    place = tmp_path_factory.mktemp("bundles")
    # of a copy: SQLite leaves an empty log beside what it has only read
    take_backup(copied(place / "house").settings, str(place / "bundles"))
    return str(place / "bundles")


@pytest.fixture
def fleet(bundles, master, postgres_url, tmp_path):
    settings = Settings(
        data_dir=tmp_path / "node", database_url=SecretStr(postgres_url), index_dir=None,
        cache_dir=master.settings.cache_dir,
    )  # fmt: skip
    restore_to_server(bundles, settings)
    return Fleet(settings, postgres_url)


def test_rows_and_blobs_are_checked_and_mended(fleet):
    assert fleet.kinds() == fleet.kinds(quick=True) == []
    [(geometry,)] = fleet.sql(f"SELECT geometry FROM signatures WHERE frame_number = {FIRST} + 4")
    (fleet.settings.blob_dir / geometry[:2] / geometry).write_bytes(b"other")
    fleet.sql(
        f"UPDATE signatures SET vector = 'x' || substr(vector, 2) WHERE frame_number = {FIRST}",
        f"DELETE FROM signatures WHERE frame_number = {FIRST} + 1",
        f"UPDATE frames SET pose_x = pose_x + 1 WHERE number = {FIRST} + 2",
        f"DELETE FROM frame_tags WHERE frame_number = {FIRST} + 3",
        f"UPDATE jobs SET state = 'dead' WHERE frame_number = {WAITING}",
        "UPDATE maps SET revision = 11, used_bytes = used_bytes - 1 WHERE name = 'hall'",
    )
    wanted = [
        "damaged-artifact", "damaged-signature", "frame-without-job", "frame-without-signature",
        "revision-ahead", "stale-value", "stale-value", "stale-value",
    ]  # fmt: skip
    assert sorted(fleet.kinds()) == wanted
    repaired = fleet.look(repair=True)
    assert sorted(one.kind for one in repaired) == wanted
    assert [one.error for one in repaired if one.left] == []
    assert fleet.work() == {JobState.SUCCEEDED}
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
