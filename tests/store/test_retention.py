"""Tests of event retention, which is independent for each map."""

import pytest

from sceneprint.store import events
from sceneprint.store.deletion import remove_map
from sceneprint.store.events import (
    EventFilter,
    anchor_of_now,
    holds_anchor,
    list_events,
    record_event,
    removal_floor,
    removal_floors,
    remove_events,
    surplus_events,
)
from sceneprint.store.maps import add_map, find_map, store_model


@pytest.fixture
def filled(store):
    """Two maps, made by the events 1 and 2; then hall, shop and none in turn, 3 to 62."""
    with store.database.write() as connection:
        store_model(connection, "m" * 64, "small", b"")
        for name in ("hall", "shop"):
            add_map(connection, name, None, "m" * 64)
        for i in range(60):
            record_event(connection, "frame.received", ("hall", "shop", None)[i % 3])
    return store


def numbers_of(connection, name):
    return [event.number for event in list_events(connection, EventFilter()) if event.map == name]


def expected(connection, count, anchors):
    """Of each map all but the newest, the one before these, and the anchors."""
    gone = set()
    for name, more in (("hall", 1), ("shop", 1), (None, 0)):
        numbers = numbers_of(connection, name)
        gone |= set(numbers[: max(len(numbers) - count - more, 0)]) - set(anchors)
    return gone


@pytest.mark.parametrize("count", [1, 19, 20, 62])
def test_what_is_not_kept_goes_and_the_anchors_stay(filled, count):
    anchor = anchor_of_now(filled.database, "shop")
    with filled.database.write() as connection:
        result = surplus_events(connection, count, (6, 33), 99)
        assert set(result) == expected(connection, count, (6, 33))
        assert len(result) == len(set(result))
        assert surplus_events(connection, count, (6, 33), 5) == result[:5]
        remove_events(connection, result)
        assert surplus_events(connection, count, (6, 33), 99) == []
        assert holds_anchor(connection, anchor)


def test_what_happens_elsewhere_moves_nothing(filled):
    shop = EventFilter(frozenset(("shop",)))
    with filled.database.write() as connection:
        before = {after: removal_floor(connection, shop, 10, after) for after in range(62)}
        own = removal_floors(connection, 10)["shop"]
        assert own == numbers_of(connection, "shop")[-11]
        assert {after for after, floor in before.items() if floor > after} == set(range(own))
        for _ in range(150):
            record_event(connection, "frame.received", "hall")
            record_event(connection, "key.created")
        assert removal_floors(connection, 10)["shop"] == own
        for after in before:  # the same is missed
            assert (removal_floor(connection, shop, 10, after) > after) == (after < own)
        gone = surplus_events(connection, 10, (), 9999)
        shop_numbers = numbers_of(connection, "shop")
        shops = [shop for shop in shop_numbers if shop < own]
        assert [row for row in gone if row in shop_numbers] == shops
        assert removal_floor(connection, EventFilter(), 10, 0) > own


def test_what_is_left_of_maps_that_are_gone_is_bounded_together(filled):
    with filled.database.write() as connection:
        remove_map(connection, find_map(connection, "hall"))
        rest = sorted(numbers_of(connection, "hall") + numbers_of(connection, None))
        assert removal_floors(connection, 10)[None] == rest[-11]
        hall = EventFilter(frozenset(("hall",)))
        assert removal_floor(connection, hall, 10, 0) == rest[-11]
        gone = surplus_events(connection, 10, (), 99)
        assert set(gone) - set(numbers_of(connection, "shop")) == set(rest[:-10])


def test_of_a_map_that_is_gone_nothing_is_missed_after_its_last_event(filled):
    hall = EventFilter(frozenset(("hall",)))
    with filled.database.write() as connection:
        remove_map(connection, find_map(connection, "hall"))
        last = numbers_of(connection, "hall")[-1]
        for _ in range(100):  # in others that are gone, and in none
            record_event(connection, "key.created")
        remove_events(connection, surplus_events(connection, 10, (), 999))
        assert numbers_of(connection, "hall") == []
        assert removal_floor(connection, hall, 10, last - 1) > last - 1
        assert removal_floor(connection, hall, 10, last) <= last
        assert removal_floor(connection, EventFilter(frozenset(("never",))), 10, 0) == 0
        assert removal_floor(connection, EventFilter(frozenset()), 10, 0) == 0


def test_names_of_maps_that_are_gone_are_bounded(filled, monkeypatch):
    monkeypatch.setattr(events, "MOST_FORMER", 3)
    with filled.database.write() as connection:
        lasts = {}
        for name in ("limited", "a", "b", "c", "d"):
            limits = {"quota_frames": 7} if name == "limited" else None
            remove_map(connection, add_map(connection, name, None, "m" * 64, limits))
            lasts[name] = numbers_of(connection, name)[-1]
        known = {name: events.last_event(connection, name) for name in lasts}
        # of the one that is forgotten it is known that it went before the oldest that is not
        assert known == lasts | {"a": lasts["b"]}
        for name, quota in (("limited", 7), ("b", None), ("a", None)):
            row = add_map(connection, name, None, "m" * 64)
            assert (row.quota_frames, row.quota_bytes) == (quota, None)
        assert events.last_event(connection, "b") == 0  # fewer than can be remembered: none is
