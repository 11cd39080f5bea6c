"""Tests of threads that take turns: fairness among tenants, timeouts and shutdown."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

from benchmarks.waiting import PATIENCE_S
from sceneprint.turns import ACTIVE_S, PRESENT_S, ThreadTurns, TurnOrder


def queue(turns, tenants, order):
    """Threads that wait for a turn in that order, and note when they have had it."""
    results = []

    def take(tenant):
        assert turns.acquire(tenant, 60)
        order.append(tenant)
        turns.release(tenant)

    for number, tenant in enumerate(tenants):
        thread = threading.Thread(target=take, args=(tenant,))
        thread.start()
        results.append(thread)
        await_waiting(turns, number + 1)
    return results


def await_waiting(turns, count):
    until = time.monotonic() + PATIENCE_S
    while len(turns._order.waiters()) != count:
        assert time.monotonic() < until
        time.sleep(0.001)


def test_a_turn_goes_to_who_was_served_the_longest_ago():
    turns, order = ThreadTurns(1), list[str]()
    assert turns.acquire("a", 60)
    threads = queue(turns, "aaaaabbc", order)
    turns.release("a")
    for thread in threads:
        thread.join()
    assert "".join(order) == "bcabaaaa"


def test_who_waits_for_too_long_gets_none_and_holds_nobody_up():
    turns, order = ThreadTurns(1), list[str]()
    assert turns.acquire("a", 60)
    assert not turns.acquire("b", 0.01)
    threads = queue(turns, "c", order)
    turns.release("a")
    threads[0].join()
    assert order == ["c"]
    assert turns.acquire("b", 0)


def test_after_the_end_there_are_no_turns():
    turns, results = ThreadTurns(1), list[bool]()
    assert turns.acquire("a", 60)
    waiting = threading.Thread(target=lambda: results.append(turns.acquire("b", 600)))
    waiting.start()
    await_waiting(turns, 1)
    turns.close()
    waiting.join(PATIENCE_S)
    assert results == [False]
    assert not turns.acquire("c", 600)


def test_beside_another_a_tenant_holds_so_many_and_alone_all():
    clock = SimpleNamespace(now=0.0)
    order = TurnOrder(4, 1, lambda: clock.now)

    def ask(*waiters):
        for waiter in waiters:
            order.enter(waiter[0], waiter)
        return order.admit()

    assert ask("a1", "a2") == ["a1", "a2"]
    assert ask("b1", "b2", "a3") == ["b1"]
    order.release("a")
    order.release("b")
    assert order.admit() == ["b2"]  # a has one still
    order.release("a")
    assert order.admit() == ["a3"]
    order.release("b")
    clock.now = PRESENT_S + 1  # b is gone
    assert ask("a4", "a5", "a6", "a7") == ["a4", "a5", "a6"]


def test_who_asks_for_several_gets_them_beside_another_too_where_it_holds_none():
    order = TurnOrder(8, 1)
    assert order.enter("b", "b1") == 1
    assert order.enter("a", "heavy", 20) == 4  # half of all at most
    assert order.admit() == ["heavy", "b1"]
    order.enter("a", "light")
    assert order.admit() == []
    order.release("a", 4)
    assert order.admit() == ["light"]


def test_beside_an_active_tenant_one_rests_as_long_as_it_held_turns():
    clock = SimpleNamespace(now=0.0)
    order = TurnOrder(4, 1, lambda: clock.now, rest=1.0)
    order.enter("b", "b1")
    order.enter("a", "a1")
    assert order.admit() == ["a1", "b1"]
    order.enter("a", "a2")
    clock.now = 0.25
    order.release("a")
    assert order.admit() == []
    assert order.rest_s() == 0.25
    clock.now = 0.375
    order.release("b")
    order.enter("b", "b2")  # b rests for what it held itself
    assert order.admit() == []
    assert order.rest_s() == 0.125
    clock.now = 0.5
    assert order.admit() == ["a2"]
    assert order.rest_s() == 0.25
    clock.now = 0.75
    assert order.admit() == ["b2"]
    assert order.rest_s() is None


def test_a_request_without_a_turn_makes_others_share_and_rest():
    clock = SimpleNamespace(now=0.0)
    order = TurnOrder(4, 1, lambda: clock.now, rest=2.0)
    order.enter("a", "a1")
    order.enter("a", "a2")
    order.record_request("b")
    assert order.admit() == ["a1"]
    clock.now = 0.25
    order.release("a")
    assert (order.admit(), order.rest_s()) == ([], 0.5)


def test_one_rests_for_its_latest_turn_and_a_second_at_most():
    clock = SimpleNamespace(now=0.0)
    order = TurnOrder(4, 2, lambda: clock.now, rest=1.0)
    order.enter("a", "a1")
    order.admit()
    clock.now = 100.0
    order.enter("a", "a2")
    order.enter("b", "b1")
    assert order.admit() == ["b1", "a2"]
    order.enter("a", "a3")
    order.release("a")
    clock.now = 100.5
    order.release("a")
    assert (order.admit(), order.rest_s()) == ([], 0.5)
    clock.now = 101.0
    order.enter("b", "b2")  # which is active still
    assert order.admit() == ["a3", "b2"]
    clock.now = 111.0
    order.release("b", 2)
    order.enter("b", "b3")
    order.enter("a", "a4")
    order.release("a")
    assert (order.admit(), order.rest_s()) == (["b3"], ACTIVE_S)


def test_a_rest_that_ends_after_the_look_is_looked_at_again_at_once():
    clock = SimpleNamespace(now=0.0)
    order = TurnOrder(4, 1, lambda: clock.now, rest=1.0)
    order.enter("b", "b1")
    order.enter("a", "a1")
    order.admit()
    clock.now = 0.25
    order.release("a")
    order.enter("a", "a2")
    assert order.admit() == []
    clock.now = 0.75  # the rest ended meanwhile: who waits would wait for ever
    assert order.rest_s() == 0.0
    assert order.admit() == ["a2"]
    assert order.rest_s() is None


def test_many_threads_never_hold_more_than_there_are():
    turns, lock = ThreadTurns(3), threading.Lock()
    holders, counts = set[int](), list[int]()

    def work(number):
        for _ in range(50):
            assert turns.acquire("abc"[number % 3], 60)
            with lock:
                holders.add(number)
                counts.append(len(holders))
            with lock:
                holders.remove(number)
            turns.release("abc"[number % 3])

    with ThreadPoolExecutor(9) as pool:
        list(pool.map(work, range(9)))
    assert (len(counts), holders) == (450, set())
    assert max(counts) <= 3
