"""Generations: appended, refitted, rewritten, cleaned, and opened again as they were."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from sceneprint.index import Generation, drafts, newest, newest_number, publish, signatures_of
from sceneprint.index.files import building
from sceneprint.index.segments import Block
from sceneprint.index.tails import Tail
from sceneprint.types import Bytes

Walk = Callable[..., Bytes]
Publish = Callable[..., Generation]
LENGTH = 256


def holds(generation: Generation | None, frames: dict[int, Bytes]) -> bool:
    """Whether a generation holds these frames with these signatures, and can code them all."""
    assert generation is not None
    keys = np.array(sorted(frames), np.int64)
    assert sorted(generation.keys.tolist()) == keys.tolist()
    assert len(generation.coarse) == len(generation) == len(generation.rows)
    stored = signatures_of(keys, generation, Tail.empty(LENGTH))
    np.testing.assert_array_equal(stored, [frames[int(key)] for key in keys])
    for key in keys[:: max(len(keys) // 7, 1)]:  # codes stand where their frames stand
        code = generation.code.encode(frames[int(key)][None])[0]
        at = generation.coarse.nearest(code, 3, np.arange(0))
        assert key in generation.keys[at]
    return True


def frames_of(keys: np.ndarray, signatures: Bytes) -> dict[int, Bytes]:
    return dict(zip(keys.tolist(), signatures, strict=True))


def files(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_what_is_published_is_what_is_opened(
    walk: Walk, published: Publish, tmp_path: Path
) -> None:
    keys, signatures = np.arange(300)[::-1] * 7 - 50, walk(300)
    made = published(keys, signatures, revision=41)
    opened = newest(tmp_path / "map", "model", LENGTH, verify=True)
    for generation in (made, opened):
        assert holds(generation, frames_of(keys, signatures))
        assert generation is not None
        assert (generation.number, generation.revision, generation.model_id) == (1, 41, "model")
        assert (generation.fitted_on, generation.dimension, len(generation)) == (300, LENGTH, 300)
        assert generation.keys.tolist() == keys.tolist()
    assert opened is not None
    assert opened.code.id == made.code.id
    np.testing.assert_array_equal(opened.code.matrix, made.code.matrix)


def test_nothing_is_found_where_nothing_is(walk: Walk, published: Publish, tmp_path: Path) -> None:
    assert newest(tmp_path / "map", "model", LENGTH) is None
    assert newest_number(tmp_path / "map") is None
    published(np.arange(5), walk(5))
    assert newest_number(tmp_path / "map") == 1
    assert newest(tmp_path / "map", "another", LENGTH) is None
    assert newest(tmp_path / "map", "model", LENGTH + 1) is None


def test_appending_leaves_what_is_there_untouched(
    walk: Walk,
    published: Publish,
    tmp_path: Path,
    fingerprints: Callable[[Path], dict[str, tuple[int, int, str]]],
) -> None:
    signatures = walk(399)
    first = published(np.arange(200), signatures[:200])
    before = fingerprints(tmp_path / "map")
    second = published(np.arange(200, 300), signatures[200:300], first, revision=1)
    third = published(np.arange(300, 399), signatures[300:], second, revision=2)
    after = fingerprints(tmp_path / "map")
    assert len(before) == 1
    assert len(after) == 3
    assert before.items() <= after.items()
    assert first.code.id == second.code.id == third.code.id
    assert third.fitted_on == 200
    assert third.segments[0] is first.segments[0]
    assert holds(third, frames_of(np.arange(399), signatures))
    assert holds(newest(tmp_path / "map", "model", LENGTH), frames_of(np.arange(399), signatures))
    assert holds(first, frames_of(np.arange(200), signatures[:200]))  # a live one never changes


def test_the_code_is_refitted_when_the_map_has_doubled(walk: Walk, published: Publish) -> None:
    signatures = walk(400)
    first = published(np.arange(200), signatures[:200])
    second = published(np.arange(200, 399), signatures[200:399], first)
    third = published(np.arange(399, 400), signatures[399:], second)
    assert first.code.id == second.code.id != third.code.id
    assert [each.fitted_on for each in (first, second, third)] == [200, 200, 400]
    assert holds(third, frames_of(np.arange(400), signatures))
    # as if published at once: all rows have codes of the new fit
    query = third.code.encode(signatures[:1])[0]
    assert third.keys[third.coarse.nearest(query, 1, np.arange(0))].tolist() == [0]


def test_deleted_and_replaced_frames(walk: Walk, published: Publish, tmp_path: Path) -> None:
    signatures, again = walk(120), walk(30, seed=5)
    first = published(np.arange(100), signatures[:100])
    keys = np.concatenate([np.arange(10, 40), np.arange(100, 120)])
    second = published(
        keys, np.concatenate([again, signatures[100:]]), first,
        drop=frozenset({0, 1, 2, 50, 110, 999}),
    )  # fmt: skip
    expected = frames_of(np.arange(120), signatures) | frames_of(np.arange(10, 40), again)
    for gone in (0, 1, 2, 50, 110):
        del expected[gone]
    assert holds(second, expected)
    assert holds(newest(tmp_path / "map", "model", LENGTH, verify=True), expected)
    assert [len(each) for each in second.segments] == [100, 50]
    third = published(np.arange(0), signatures[:0], second, revision=9)  # nothing but a revision
    assert holds(third, expected)
    assert (third.number, third.revision, len(third.segments)) == (3, 9, 2)


def test_segments_are_rewritten_when_most_rows_are_gone(
    walk: Walk, published: Publish, tmp_path: Path
) -> None:
    signatures = walk(130)
    first = published(np.arange(100), signatures[:100])
    second = published(np.arange(100, 110), signatures[100:110], first, drop=frozenset(range(50)))
    assert [len(each) for each in second.segments] == [100, 10]
    # 60 of 110 live: one more than half; 54 of 110 do not suffice
    third = published(np.arange(110, 130), signatures[110:], second, drop=frozenset(range(50, 56)))
    assert [len(each) for each in third.segments] == [54, 20]
    assert third.code.id == first.code.id
    assert holds(third, frames_of(np.arange(56, 130), signatures[56:]))
    last = published(np.arange(0), signatures[:0], third, drop=frozenset(range(130)))
    assert (len(last), len(last.segments)) == (0, 0)
    opened = newest(tmp_path / "map", "model", LENGTH)
    assert opened is not None
    assert len(opened) == 0
    anew = published(np.arange(3), signatures[:3], opened)
    assert holds(anew, frames_of(np.arange(3), signatures[:3]))


def test_many_segments_become_one(
    walk: Walk, published: Publish, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drafts, "MANY", 4)
    signatures = walk(107)
    generation = published(np.arange(100), signatures[:100])
    counts = []
    for key in range(100, 107):
        generation = published(np.array([key]), signatures[key : key + 1], generation)
        counts.append(len(generation.segments))
    assert counts == [2, 3, 4, 2, 3, 4, 2]
    assert holds(generation, frames_of(np.arange(107), signatures))


def test_two_generations_are_kept_and_only_our_files_removed(
    walk: Walk, published: Publish, tmp_path: Path
) -> None:
    folder, signatures = tmp_path / "map", walk(160)
    generation = published(np.arange(100), signatures[:100])
    (folder / ".0123456789ab.part").write_bytes(b"of a killed builder")
    (folder / f"{'0' * 64}.faiss").write_bytes(b"of no manifest")
    (folder / "notes.txt").write_text("of somebody else")
    for key in range(100, 105):
        generation = published(np.array([key]), signatures[key : key + 1], generation)
    names = files(folder)
    assert {".lock", "notes.txt"} <= names
    kinds = sorted(name.rpartition(".")[2] for name in names - {".lock", "notes.txt"})
    assert kinds == ["code", "faiss", "faiss", "json", "json", "rows", "rows"] + 6 * ["segment"]
    assert newest_number(folder) == 6


def test_what_is_open_is_taken_from_there(walk: Walk, published: Publish, tmp_path: Path) -> None:
    signatures = walk(150)
    first = published(np.arange(100), signatures[:100])
    published(np.arange(100, 150), signatures[100:], first)
    found = newest(tmp_path / "map", "model", LENGTH, known=first)
    assert found is not None
    assert found.segments[0] is first.segments[0]
    assert found.code is first.code
    assert holds(found, frames_of(np.arange(150), signatures))
    verified = newest(tmp_path / "map", "model", LENGTH, known=first, verify=True)
    assert verified is not None
    assert verified.segments[0] is not first.segments[0]


def test_one_builds_at_a_time(walk: Walk, published: Publish, tmp_path: Path) -> None:
    folder, signatures = tmp_path / "map", walk(20)
    first = published(np.arange(10), signatures[:10])
    new: Block = (np.arange(10, 20), signatures[10:])
    with building(folder) as mine:
        assert mine
        with building(folder) as another:  # of the same process as well
            assert not another
        assert publish(folder, model_id="model", revision=1, blocks=[new], previous=first) is None
    assert newest_number(folder) == 1
    second = published(*new, first)
    # the loser of a race has built on what is no longer the newest
    assert publish(folder, model_id="model", revision=1, blocks=[new], previous=first) is None
    assert newest_number(folder) == second.number == 2
    # from nothing is always allowed, and follows in number
    third = published(np.arange(4), signatures[:4])
    assert third.number == 3
    assert holds(newest(folder, "model", LENGTH), frames_of(np.arange(4), signatures[:4]))


def test_an_emptied_folder_is_noticed(walk: Walk, published: Publish, tmp_path: Path) -> None:
    folder, signatures = tmp_path / "map", walk(20)
    first = published(np.arange(10), signatures[:10])
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()
    new: Block = (np.arange(10, 20), signatures[10:])
    assert publish(folder, model_id="model", revision=1, blocks=[new], previous=first) is None
    assert newest(folder, "model", LENGTH) is None
    assert holds(first, frames_of(np.arange(10), signatures[:10]))


def test_mistakes_leave_the_generation_before(
    walk: Walk, published: Publish, tmp_path: Path
) -> None:
    folder, signatures = tmp_path / "map", walk(20)
    first = published(np.arange(10), signatures[:10])
    before = files(folder)

    def broken() -> Iterator[Block]:
        yield np.arange(10, 12), signatures[10:12]
        raise ConnectionError("the database went away")

    def attempt(blocks: object, model: str = "model") -> None:
        publish(folder, model_id=model, revision=1, blocks=blocks, previous=first)  # type: ignore[arg-type]

    with pytest.raises(ConnectionError):
        attempt(broken())
    assert files(folder) == before
    with pytest.raises(ValueError, match=r"\[10\] are there twice"):
        attempt([(np.array([10, 11, 10]), signatures[10:13])])
    with pytest.raises(ValueError, match=r"\[255, 256\] bytes in one map"):
        attempt([(np.arange(10, 12), signatures[10:12, 1:])])
    with pytest.raises(ValueError, match="model other appended to those of model"):
        attempt([], "other")
    with pytest.raises(ValueError, match="of no frames"):
        publish(folder, model_id="model", revision=1, blocks=[], previous=None)
    assert holds(newest(folder, "model", LENGTH), frames_of(np.arange(10), signatures[:10]))
    published(np.arange(10, 20), signatures[10:], first)
    assert holds(newest(folder, "model", LENGTH), frames_of(np.arange(20), signatures))


def test_a_failure_at_any_step_leaves_the_old_or_the_new(
    walk: Walk, published: Publish, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk that fills, at each of the calls that give a file its name or make it durable."""
    signatures, real = walk(60), {"replace": os.replace, "fsync": os.fsync}
    seen = set()
    for call in ("replace", "fsync"):
        for step in range(100):
            folder = tmp_path / f"{call}-{step}"
            first = published(np.arange(40), signatures[:40], folder=folder)
            left = step

            def failing(*arguments: object, call: str = call) -> None:
                nonlocal left
                left -= 1
                if left < 0:
                    raise OSError(28, "No space left on device")
                real[call](*arguments)  # type: ignore[operator]

            with monkeypatch.context() as patch:
                patch.setattr(os, call, failing)
                with contextlib.suppress(OSError):
                    published(np.arange(40, 60), signatures[40:], first, folder=folder)
            found = newest(folder, "model", LENGTH, verify=True)
            assert found is not None
            n = {1: 40, 2: 60}[found.number]
            assert holds(found, frames_of(np.arange(n), signatures[:n]))
            assert not list(folder.glob(".*.part"))
            seen.add((call, found.number))
            if left >= 0:
                break
        assert step >= 3
    assert {("replace", 1), ("replace", 2), ("fsync", 1), ("fsync", 2)} <= seen
