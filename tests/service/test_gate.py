"""Tests of the gate: a few requests run, some wait for a limited time, and others are rejected."""

import asyncio
import threading

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import Busy
from service.limits import Gate


def test_who_waits_too_long_is_sent_away_and_nothing_of_it_is_begun():
    done = threading.Event()
    begun = []

    def work(name):
        begun.append(name)
        assert done.wait(PATIENCE_S)
        return name

    async def test():
        gate = Gate(1, 5, longest_s=0.2)
        first = asyncio.create_task(gate.run(lambda: work("first")))
        while not begun:
            await asyncio.sleep(0.01)
        waiting = [asyncio.create_task(gate.run(lambda: work("late"))) for _ in range(2)]
        for one in waiting:
            with pytest.raises(Busy, match=r"in 0\.2 s\. Nothing was stored"):
                await one
        done.set()
        assert await first == "first"
        assert await gate.run(lambda: work("next")) == "next"  # its turn is free again

    asyncio.run(test())
    assert begun == ["first", "next"]


def test_who_hangs_up_while_it_waits_leaves_no_turn_behind():
    done = threading.Event()

    async def test():
        gate = Gate(1, 5, longest_s=30)
        first = asyncio.create_task(gate.run(lambda: done.wait(PATIENCE_S)))
        await asyncio.sleep(0.05)
        second = asyncio.create_task(gate.run(lambda: True))
        await asyncio.sleep(0.05)
        second.cancel()
        done.set()
        assert await first is True
        assert await asyncio.wait_for(gate.run(lambda: "third"), PATIENCE_S) == "third"
        with pytest.raises(asyncio.CancelledError):
            await second

    asyncio.run(test())
