"""`make siege` at reduced size, with real processes; and that it would see what goes wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.siege.__main__ import (
    besieged,
    known_of,
    neighbours,
)
from benchmarks.siege.attacks import ATTACKS
from benchmarks.siege.contract import read_report, try_contract
from benchmarks.siege.mutations import besiege, mutated
from benchmarks.siege.overload import overload
from benchmarks.siege.sound_files import FILES
from benchmarks.soak.load import Shot, shots


@pytest.fixture(scope="module")
def every() -> list[Shot]:
    return shots(24)


def test_broken_uploads_are_answered(every: list[Shot], tmp_path: Path) -> None:
    with besieged(tmp_path / "data", every[:2], decoders=2) as (url, part):
        found = besiege(url, [part], every, n=24, seed=11)
    assert (found.failed, found.crashed, found.replaced) == ([], 0, 0)
    assert sum(found.statuses.values()) == 24
    assert {202, 422} <= set(found.statuses)
    assert found.peak_bytes < 1 << 30
    assert 0 < found.decoder_bytes < 1 << 30


@pytest.mark.thorough
def test_broken_uploads_and_every_operation_are_answered(every: list[Shot], tmp_path: Path) -> None:
    with besieged(tmp_path / "data", every[:2], decoders=2) as (url, part):
        found = besiege(url, [part], every, n=300, seed=5)
        assert (found.failed, found.crashed) == ([], 0)
        assert sum(found.statuses.values()) == 300
        assert set(found.sent) == {"json", *FILES}
        assert {200, 202, 422} <= set(found.statuses)  # some are sound after all
        assert found.peak_bytes < 1 << 30
        known = known_of(url)
        tried = try_contract(url, tmp_path, known=known, examples=2, phases="fuzzing")
        assert tried.sound, tried.report[-4000:]
        assert tried.operations >= 40
        assert tried.requests > tried.operations


@pytest.mark.thorough
def test_a_tenant_is_refused_nothing_while_another_does_its_worst(
    every: list[Shot], tmp_path: Path
) -> None:
    found = neighbours(tmp_path / "data", every[:2], 1.0, counts=(2,))
    assert [(one.attack, one.keys) for one in found] == [(name, 2) for name in ATTACKS]
    assert [one.under.refused for one in found] == [0] * len(ATTACKS)
    assert all(one.sent > 0 and len(one.under.signed_s) > 0 for one in found)
    refused = {one.attack: one.refused for one in found}
    assert refused["event streams"] > 0


@pytest.mark.thorough
def test_too_many_requests_are_sent_away_and_nothing_is_lost(
    every: list[Shot], tmp_path: Path
) -> None:
    with besieged(tmp_path / "data", every[:4], waiting=8) as (url, _):
        found = overload(url, every, seconds=4, factor=10, measure_s=1.5)
    assert set(found.statuses) <= {200, 202, 429, 503}
    assert found.statuses[503] + found.statuses.get(429, 0) > 0
    assert (found.without_word, found.lost) == (0, 0)
    assert found.acknowledged >= 10
    assert found.recovery_s < 60


def test_mutations_are_the_same_each_time_and_break_things(every: list[Shot]) -> None:
    first = [mutated(every, 3, number) for number in range(50)]
    assert first == [mutated(every, 3, number) for number in range(50)]
    assert first != [mutated(every, 4, number) for number in range(50)]
    sound = {(one.png, one.meta.model_dump_json()) for one in every}
    assert sum((one.data, one.meta) not in sound for one in first) >= 48


@pytest.mark.parametrize(
    ("line", "code", "figures", "sound"),
    [
        ("15575 generated, 1 found 1 unique failure", 1, (15575, 15574), False),
        ("90 generated, 7 found 2 unique failures", 1, (90, 83), False),
        ("15330 generated, 15330 passed", 0, (15330, 15330), True),
        ("15330 generated, 15330 passed", 1, (15330, 0), False),
        ("no test cases were generated", 0, (0, 0), False),
    ],
)
def test_what_schemathesis_counted(
    line: str, code: int, figures: tuple[int, int], sound: bool
) -> None:
    found = read_report(f"  Tested: 104\n\nTest cases:\n  {line}\n", code)
    assert (found.requests, found.passed, found.sound) == (*figures, sound)
