"""`make siege` at reduced size, with real processes; and that it would see what goes wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.pages import put_between
from benchmarks.siege import decoders
from benchmarks.siege.__main__ import (
    ASKED_OF,
    BEGIN,
    END,
    besieged,
    known_of,
    neighbours,
    table,
)
from benchmarks.siege.attacks import ATTACKS
from benchmarks.siege.contract import ContractFigures, read_report, try_contract
from benchmarks.siege.fuzz import Fuzzed, decoder_table, http_table
from benchmarks.siege.mutations import MutationFigures, besiege, mutated
from benchmarks.siege.neighbours import (
    NeighbourFigures,
    VictimFigures,
    neighbour_table,
)
from benchmarks.siege.overload import OverloadFigures, overload
from benchmarks.siege.sound_files import FILES
from benchmarks.soak.load import Shot, shots
from sceneprint.errors import UnreadableModel


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


def test_the_table_of_neighbours_tells_the_99th_percentile() -> None:
    calm = VictimFigures([0.01] * 99 + [0.02], [0.5])
    found = [NeighbourFigures("x", 2, calm, VictimFigures([0.03], [1.5], 4), 9, 7)]
    assert neighbour_table(found)[2] == (
        "| x | 2 | 10 ms | 30 ms | 3.0 | 500 ms | 1500 ms | 3.0 | **4** | 9 | 7 |"
    )


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


def test_the_page_tells_what_was_measured(tmp_path: Path) -> None:
    mutations = MutationFigures(
        {"png": 3, "tar": 1}, {202: 1, 422: 3}, ["x"], 2, 3 << 20, 5 << 20, 6, 7.0
    )
    contract = ContractFigures(41, 10, 9, "")
    overloaded = OverloadFigures(
        50.0, 500.0, 4.0, {200: 3, 503: 9}, 1, (10.0, 20.0), (1.0, 2.0), 5, 1, 0.5
    )
    lines = table(mutations, [contract] * len(ASKED_OF), overloaded)
    page = tmp_path / "page.md"
    page.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    put_between(page, BEGIN, END, lines)
    text = page.read_text()
    assert text.startswith("before")
    assert text.endswith("after\n")
    assert "old" not in text
    for part in (
        "4 broken uploads within 7 s", "3 png, 1 tar", "1 of 202, 3 of 422", "| **1** |",
        "| **2** |", "3 MiB", "5 MiB", "replaced | 6 |", "(41)", "| no key | 9 of 10 |",
        "500 requests a second where 50", "5, **1**", "0.5 s",
    ):  # fmt: skip
        assert part in text, part


@pytest.mark.parametrize(
    ("changed", "sound"),
    [({}, True), ({"passed": 9}, False), ({"requests": 0, "passed": 0}, False)],
)
def test_a_contract_that_was_not_tried_is_not_kept(changed: dict[str, int], sound: bool) -> None:
    assert replace(ContractFigures(3, 10, 10, ""), **changed).sound is sound


@pytest.mark.parametrize("name", decoders.TARGETS)
def test_what_a_fuzzer_begins_with_is_sound(name: str, tmp_path: Path) -> None:
    """So that mutations go deep; of a model and a sidecar the first is not whole on purpose."""
    decoders.write_seeds(name, tmp_path)
    inputs = [one.read_bytes() for one in (tmp_path / "corpus").iterdir()]
    assert 2 <= len(inputs) == len(decoders.TARGETS[name].seeds())
    assert max(map(len, inputs)) <= decoders.TARGETS[name].most or name in ("archive", "bag")
    read = decoders.TARGETS[name].reader()
    for data in inputs:
        if name == "model" and data[:1] == b"\0":
            with pytest.raises(UnreadableModel):
                read(data)
        else:
            read(data)


def test_a_fuzzers_findings_are_noted_once_a_place(tmp_path: Path) -> None:
    (tmp_path / "findings").mkdir()

    def read(data: bytes) -> object:
        if data == b"stated":
            raise UnreadableModel("it is none")
        return data[9] / 0 if data else 1 / 0

    assert decoders._unstated(read, b"stated") is None
    for data in (b"short", b"other", b""):
        why = decoders._unstated(read, data)
        assert why is not None
        decoders._note(tmp_path, "unstated", data, why)
    files = list((tmp_path / "findings").iterdir())
    told = sorted(one.read_text().partition(":")[0] for one in files if one.suffix == ".txt")
    assert told == ["IndexError in test_siege.py", "ZeroDivisionError in test_siege.py"]
    assert sorted(one.read_bytes() for one in files if not one.suffix) == [b"", b"short"]


def test_the_tables_of_fuzzers() -> None:
    found = [Fuzzed("ply", 70, 5.4, ["x"], {"edges": 9, "s": 0.126, "bytes": 3 << 20})]
    assert decoder_table(found)[-1] == "| ply | 70 | 5 | 9 | 0.13 | 3.0 | **1** |"
    assert http_table(found)[-1] == "| ply | 70 | 5 | **1** |"
    assert not found[0].sound
    assert not Fuzzed("ply", 0, 5.0, []).sound
    assert Fuzzed("ply", 1, 5.0, []).sound
