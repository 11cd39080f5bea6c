"""Tests of keys: their secrets, and the time of their last use."""

import hashlib

import pytest
from sqlalchemy import select

from sceneprint.errors import Conflict, UnknownKey
from sceneprint.store import keys
from sceneprint.store.tables import events
from sceneprint.store.tables import keys as table


@pytest.fixture
def clock(monkeypatch):
    """The time that keys go by; to be moved by hand."""
    now = [1_000_000.0]
    monkeypatch.setattr(keys.time, "time", lambda: now[0])
    return now


def test_a_secret_ends_with_its_overlap_and_the_next_goes_on(store, clock):
    with store.database.write() as connection:
        first = keys.create_key(connection, "robot", {"hall": "write"}, 1_000_900.0)
        second = keys.rotate_key(connection, "robot", 100)
        ends = [keys.find_key(connection, secret).expires_at for secret in (first, second)]
        assert ends == [1_000_100.0, 1_000_900.0]  # of the old secret, when it does
        clock[0] += 99
        third = keys.rotate_key(connection, "robot", 500)  # the first keeps its end
        rows = [keys.find_key(connection, secret) for secret in (first, second, third)]
        assert [row and row.grants for row in rows] == [{"hall": "write"}, None, {"hall": "write"}]
        clock[0] += 1
        assert keys.find_key(connection, first) is None
        fourth = keys.rotate_key(connection, "robot", 5000)  # a key ends with its own end
        ends = [keys.find_key(connection, secret).expires_at for secret in (third, fourth)]
        assert ends == [1_000_900.0, 1_000_900.0]
        with pytest.raises(UnknownKey, match="'cart'"):
            keys.rotate_key(connection, "cart", 1)
        keys.revoke_key(connection, "robot")
        assert [keys.find_key(connection, secret) for secret in (third, fourth)] == [None, None]


def test_a_use_is_written_once_an_hour(store, clock):
    uses = keys.KeyUses()

    def used():
        with store.database.read() as connection:
            return list(connection.execute(select(table.c.last_used_at)).scalars())

    with store.database.write() as connection:
        secret = keys.create_key(connection, "robot", {"*": "read"})

    def use():
        with store.database.read() as connection:
            key = keys.find_key(connection, secret)
        assert key is not None
        uses.note(key)

    use()
    assert used() == [None]  # nobody waits for it to be written
    uses.write(store.database)
    assert used() == [1_000_000.0]
    for seconds, expected in ((3599, 1_000_000.0), (1, 1_003_600.0), (-7200, 996_400.0)):
        clock[0] += seconds  # the last: a clock that was set back
        use()
        uses.write(store.database)
        assert used() == [expected]


def test_a_key_is_shown_once_and_kept_as_a_hash(store):
    with store.database.write() as connection:
        assert keys.list_keys(connection) == []
        secret = keys.create_key(connection, "fleet", {"*": "admin"})
        other = keys.create_key(connection, "dashboard", {"hall": "read"}, 5.0)
    assert secret.startswith("sp_")
    assert len(secret) == 46
    with pytest.raises(Conflict, match="A key named 'fleet'"), store.database.write() as connection:
        keys.create_key(connection, "fleet", {"*": "admin"})
    with store.database.read() as connection:
        assert [key.name for key in keys.list_keys(connection)] == ["dashboard", "fleet"]
        key_rows = [keys.find_key(connection, s) for s in (secret, other, secret[:-1], "")]
        assert [k and (k.name, k.grants, k.expires_at) for k in key_rows] == [
            ("fleet", {"*": "admin"}, None), ("dashboard", {"hall": "read"}, 5.0), None, None,
        ]  # fmt: skip
        rows = connection.execute(select(table).order_by(table.c.name.desc())).all()
        assert [row.digest for row in rows] == [
            hashlib.sha256(s.encode()).hexdigest() for s in (secret, other)
        ]
        event_rows = connection.execute(select(events)).all()
    assert [(each.kind, each.data) for each in event_rows] == [
        ("key.created", {"name": "fleet"}), ("key.created", {"name": "dashboard"}),
    ]  # fmt: skip
    assert secret not in repr(rows) + repr(event_rows)
    with store.database.write() as connection:
        keys.revoke_key(connection, "fleet")
        assert keys.find_key(connection, secret) is None
        assert keys.find_key(connection, other) is not None
    with pytest.raises(UnknownKey, match="no key named 'fleet'"), store.database.write() as c:
        keys.revoke_key(c, "fleet")
