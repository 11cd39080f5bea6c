"""`make soak` at reduced size, with real processes; and that it would see what is lost or wrong."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.pages import put_between
from benchmarks.soak import kills
from benchmarks.soak.__main__ import BEGIN, END, table
from benchmarks.soak.answers import State
from benchmarks.soak.clocks import find_library, jump_clocks
from benchmarks.soak.crowd import STABLE, crowd
from benchmarks.soak.crowd_audit import CrowdFigures, K, check, faults
from benchmarks.soak.kills import KillFigures, figures, kill
from benchmarks.soak.load import shots
from benchmarks.soak.writers import Plan


@pytest.mark.thorough  # test_kill kills a service in every run
@pytest.mark.parametrize(
    ("frames", "n_kills", "queries"),  # of each frame that stays its ranking, of some validated
    [(10, 3, 9 + 9), (60, 14, 54 + 9)],
)
def test_kills_lose_nothing(
    frames: int, n_kills: int, queries: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kills, "PAUSE_S", (0.2, 1.2))
    found = kill(tmp_path, shots(frames), n_kills=n_kills, seed=2)
    assert sum(found.kills.values()) == n_kills
    assert (found.acknowledged, found.deleted) == (frames, frames // 10)
    assert (found.lost, found.doubled, found.separated, found.half_written) == (0, 0, 0, 0)
    assert found.queries == queries
    assert (found.differing, found.wrong) == (0, 0)


@pytest.mark.thorough
def test_a_crowd_sees_nothing_wrong(tmp_path: Path) -> None:
    found = crowd(tmp_path, shots(STABLE + 40), 3, 3, seconds=6, seed=1)
    assert (found.errors, found.locked, found.wrong) == ([], 0, [])
    assert min(found.uploads, found.answers) >= 6


@pytest.mark.thorough
@pytest.mark.skipif(find_library() is None, reason="libfaketime is not installed")
def test_clocks_that_jump_lose_nothing(tmp_path: Path) -> None:
    library = find_library()
    assert library is not None
    found = jump_clocks(tmp_path, shots(24), library)
    assert (found.jumps, found.held.acknowledged, found.held.deleted) == (7, 21, 2)
    assert found.sound, found
    assert found.due == 3  # the rule that somebody set: it acts by the clock that there is


def state(**changed: Any) -> State:
    same: dict[str, Any] = {
        "contents": {"f0": "c0", "f1": "c1"}, "signatures": {"c0": b"0", "c1": b"1"},
        "doubled": 0, "tries": 1, "separated": 0, "answers": {"c0 ranked": [1]},
    }  # fmt: skip
    return State(**same | changed)


@pytest.mark.parametrize(
    ("changed", "counted"),
    [
        ({}, {}),
        ({"contents": {"f0": "c0"}}, {"lost": 1}),
        ({"contents": {"f0": "c0", "f1": "c1", "f2": "c2"}}, {"lost": 1}),  # it was deleted
        ({"contents": {"f0": "c0", "f1": "c1", "f9": "c9"}}, {"doubled": 1}),  # nobody's
        ({"doubled": 2}, {"doubled": 2}),
        ({"separated": 3}, {"separated": 3}),
        ({"signatures": {"c0": b"0", "c1": b"other"}}, {"differing": 1}),
        ({"signatures": {"c0": b"0"}}, {"differing": 1}),
        ({"answers": {"c0 ranked": [2]}}, {"wrong": 1}),
        ({"answers": {}}, {"wrong": 1}),
    ],
)
def test_what_is_lost_is_counted(changed: dict[str, Any], counted: dict[str, int]) -> None:
    plan = Plan(range(3))
    plan.acknowledged, plan.deleted = {0: "f0", 1: "f1", 2: "f2"}, {"f2"}
    found = figures(Counter(service=1), plan, 0, 0, state(**changed), state(), 1.0)
    names = ("lost", "doubled", "separated", "half_written", "differing", "wrong")
    told = {name: getattr(found, name) for name in names}
    assert told == dict.fromkeys(names, 0) | counted


def note(*matches: tuple[str, int], begun: float = 5.0) -> dict[str, Any]:
    found = [list(one) for one in matches]
    return {"asked": "s0", "found": found, "begun": begun, "done": begun + 0.5}


OUT_OF_ORDER = "the matches are not in their order, or one is there twice"


@pytest.mark.parametrize(
    ("answer", "wrong"),
    [
        (note(("s1", 16), ("w", 32)), []),
        (note(("s1", 16), ("stranger", 20), ("w", 32)), []),  # not acknowledged before the end
        (note(("s1", 16), ("w", 33)), ["w at 33, which is not its distance"]),
        (
            note(("w", 32), ("s1", 16)),
            [OUT_OF_ORDER],
        ),
        (
            note(("s1", 16), ("s1", 16)),
            [OUT_OF_ORDER],
        ),
        (note(("w", 32)), ["s1 at 16 is missing"]),
        (note(), ["0 matches, where 0 can have been deleted meanwhile"]),
        (note(begun=6.8), []),  # one was being deleted
        (note(("s1", 16), ("w", 32), begun=8.0), ["w is found, and was deleted before"]),
        (note(("s1", 16), ("w", 32), begun=6.5), []),  # it was being deleted
    ],
)
def test_a_wrong_answer_is_seen(answer: dict[str, Any], wrong: list[str]) -> None:
    vectors = np.array([[0, 0], [4, 0], [4, 4]], np.uint8)
    numbers, stable = {"s0": 0, "s1": 1, "w": 2}, {"s0": 0, "s1": 1}
    assert faults(answer, numbers, {"w": (6.0, 7.0)}, stable, vectors) == wrong


def test_a_frame_beyond_the_last_match_is_not_missed() -> None:
    vectors = np.array([0, 40, *range(1, K + 1)], np.uint8)[:, None]
    numbers = {f"w{i}": i + 1 for i in range(1, K + 1)}
    answer = note(*[(f"w{i}", i * i) for i in range(1, K + 1)])
    assert faults(answer, numbers, {}, {"s0": 0, "s1": 1}, vectors) == []


def test_the_page_is_rewritten_between_its_marks(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    of_kills = KillFigures({"service": 3, "a writer": 1}, 9, 1, 0, 0, 0, 0, 2, 0, 40, 0, 5, 3, 60.0)
    lines = table(of_kills, CrowdFigures(8, 8, 120, 5, 6, 7))
    put_between(page, BEGIN, END, lines)
    text = page.read_text()
    assert text.startswith(f"before\n{BEGIN}\n### 4 kills within 60 s\n")
    assert text.endswith(f"{END}\nafter\n")
    assert "SIGKILL of 1 of a writer, 3 of service, under load." in text
    assert "| uploads acknowledged, of them deleted again | 9, 1 |" in text
    assert "old" not in text


def test_errors_of_any_log_are_seen(tmp_path: Path) -> None:
    import logging

    from sceneprint.process import JsonFormatter

    def line(level: int, message: str) -> str:
        return JsonFormatter().format(logging.LogRecord("x", level, "", 0, message, None, None))

    logs = [
        "\n".join([line(logging.INFO, "fine"), line(logging.ERROR, "request failed")]),
        line(logging.WARNING, "other writers of this process have waited for long"),
    ]
    found = CrowdFigures(1, 1, 1)
    check(found, [], {}, [{"error": "the service says no"}], logs)
    assert [one for one in found.errors if "request failed" in one]
    assert (len(found.errors), found.locked) == (2, 1)
