"""Tests of `sceneprint keys`: creation, list and revocation in a data folder."""

from datetime import UTC, datetime, timedelta

import pytest

from sceneprint.settings import Settings
from tests.whole_engine import Engine


@pytest.fixture
def keys(sceneprint, tmp_path):
    def run(*arguments, expect=0):
        return sceneprint("keys", *arguments, "--data", tmp_path, expect=expect)

    return run


def listed(keys, what="--list"):
    """Return the lines of keys or tenants without the time of their creation."""
    return [line[22:] for line in keys(what).stdout.splitlines()]


def test_keys_are_made_listed_and_revoked(keys, tmp_path):
    assert keys("--list").stdout == ""
    before = datetime.now(UTC).replace(microsecond=0)
    secrets = [keys("--create", name).stdout.strip() for name in ("robot 1", "robot 2")]
    lines = keys("--list").stdout.splitlines()
    assert [line[20:] for line in lines] == ["  robot 1  admin of all", "  robot 2  admin of all"]
    for line in lines:
        assert before <= datetime.fromisoformat(line[:20]) <= datetime.now(UTC)
    assert keys("--revoke", "robot 1").stdout == "key robot 1 is revoked\n"
    assert listed(keys) == ["robot 2  admin of all"]
    again = keys("--revoke", "robot 1", expect=2)
    assert again.stderr.startswith("sceneprint keys: There is no key named 'robot 1'")
    with Engine(Settings(data_dir=tmp_path, database_url=None)) as engine:
        rows = [engine.find_key(secret) for secret in secrets]
    assert [row and (row.name, row.grants) for row in rows] == [None, ("robot 2", {"*": "admin"})]


def test_a_key_gets_a_new_secret_while_the_old_one_works(keys, tmp_path):
    def named(secret):
        with Engine(Settings(data_dir=tmp_path, database_url=None)) as engine:
            key = engine.find_key(secret)
            return None if key is None else key.name

    old = keys("--create", "robot", "--scope", "read", "--expires", "3d").stdout.strip()
    done = keys("--rotate", "robot", "--overlap", "2h")
    new, said = done.stdout.strip(), done.stderr.splitlines()
    assert said[0].startswith("save this secret now")
    until = datetime.fromisoformat(said[1].removeprefix("the old secret works until "))
    assert timedelta(seconds=7000) < until - datetime.now(UTC) <= timedelta(hours=2)
    assert [named(secret) for secret in (old, new)] == ["robot", "robot"]
    done = keys("--list")
    assert "robot  read of all, until 2" in done.stdout
    assert f", old secret until {until:%Y-%m-%dT%H:%M:%SZ}" in done.stdout
    assert done.stderr == "expiring within 7 days: robot. Create new keys with --create.\n"
    last = keys("--rotate", "robot", "--overlap", "0").stdout.strip()
    assert [named(secret) for secret in (old, last)] == [None, "robot"]
    assert "no key named 'nobody'" in keys("--rotate", "nobody", expect=2).stderr
    refused = keys("--rotate", "robot", "--overlap", "31d", expect=2).stderr
    assert "not between 0 s and 30 days" in refused


def test_a_key_may_do_what_it_was_made_for(keys, tmp_path):
    keys("--create", "robot", "--scope", "write", "--map", "hall", "--map", "yard")
    with Engine(Settings(data_dir=tmp_path, database_url=None)) as engine:
        engine.create_key("late", expires_at=datetime.now(UTC) - timedelta(days=1))
    late, robot = listed(keys)
    assert robot == "robot  write of hall, write of yard"
    assert ", expired " in late


def test_tenants_are_made_listed_and_deleted(keys):
    assert keys("--create-tenant", "acme").stdout == "tenant acme is created\n"
    assert "A tenant named 'acme'" in keys("--create-tenant", "acme", expect=2).stderr
    keys("--create", "robot", "--tenant", "acme", "--scope", "read")
    keys("--create", "alone", "--scope", "read")
    done = keys("--create", "x", "--tenant", "other", expect=2)
    assert "There is no tenant named 'other'" in done.stderr
    assert listed(keys) == ["alone  read of all", "robot  read of all, tenant acme"]
    assert listed(keys, "--list-tenants") == ["acme  1 key", "alone  1 key"]
    assert "has keys" in keys("--delete-tenant", "acme", expect=2).stderr
    for name in ("robot", "alone"):  # the tenant that came with a key goes with it
        keys("--revoke", name)
    assert listed(keys, "--list-tenants") == ["acme  0 keys"]
    assert keys("--delete-tenant", "acme").stdout == "tenant acme is deleted\n"
    assert "no tenant named 'acme'" in keys("--delete-tenant", "acme", expect=2).stderr


@pytest.mark.parametrize("time", ["30", "d", "0d", "-1d", "999999w"])
def test_a_time_is_written_as_it_is_read(keys, time):
    with pytest.raises(SystemExit):
        keys("--create", "x", "--expires", time)
