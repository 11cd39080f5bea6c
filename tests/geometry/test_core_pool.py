"""Tests that two halves run in parallel only on free cores."""

import threading

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.geometry.kernel import Cores, run_both


@pytest.fixture
def two():
    cores = Cores(2)
    yield cores
    cores.close()


def meeting():
    """Two computations that only end if they run at once."""
    barrier = threading.Barrier(2)

    def half(number):
        def run():
            barrier.wait(PATIENCE_S)
            return number

        return run

    return half(1), half(2)


def threads_of(halves=2):
    """Which threads run the halves."""
    names = []

    def note():
        names.append(threading.current_thread().name)

    run_both(note, note)
    assert len(names) == halves
    return sorted(names)


def test_halves_run_at_once_where_a_core_is_free(two):
    with two.shared():
        assert run_both(*meeting()) == (1, 2)
        assert run_both(lambda: run_both(lambda: 1, lambda: 2), lambda: 3) == ((1, 2), 3)


def test_halves_run_in_turn_without_a_free_core(two):
    own = threading.current_thread().name
    assert threads_of() == [own, own]  # not lent
    with two.shared():
        assert threads_of() != [own, own]
        with two.shared():  # as by another query
            assert threads_of() == [own, own]
        assert threads_of() != [own, own]  # given back
    assert threads_of() == [own, own]
    alone = Cores(1)
    with alone.shared():
        assert threads_of() == [own, own]
    alone.close()


@pytest.mark.parametrize("lent", [True, False])
def test_what_a_half_raises_is_raised_and_the_core_is_free_again(two, lent):
    def fail(why):
        def run():
            raise ValueError(why)

        return run

    def ask(first, second):
        if not lent:
            return run_both(first, second)
        with two.shared():
            return run_both(first, second)

    with pytest.raises(ValueError, match="first"):
        ask(fail("first"), lambda: 2)
    with pytest.raises(ValueError, match="second"):
        ask(lambda: 1, fail("second"))
    with pytest.raises(ValueError, match="first"):
        ask(fail("first"), fail("second"))
    with two.shared():
        assert run_both(*meeting()) == (1, 2)
