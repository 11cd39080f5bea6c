"""Which frames are the database and which the queries.

PATH@db=0:600:2,queries=650:  --parse_part-->  Part  --choose-->  Protocol
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from sceneprint.datasets import FrameReference, find_sequences
from sceneprint.datasets import Sequence as Run
from sceneprint.errors import DatasetError

Use = Literal["database", "query", "both"]

_RANGE = re.compile(r"(\d{1,9})?:(\d{1,9})?(?::(\d{1,9}))?", re.ASCII)
_OWN_RANGES = re.compile(r"(.+)@((?:db|queries)=[^@]*)", re.DOTALL)


@dataclass(frozen=True)
class Range:
    """Frames start, start + step, ... before stop; None: from the first, to the last, not said."""

    start: int | None
    stop: int | None
    step: int | None

    def __str__(self) -> str:
        ends = [self.start, self.stop, *([self.step] if self.step else [])]
        return ":".join("" if end is None else str(end) for end in ends)


Ranges = tuple[Range, ...]


@dataclass(frozen=True)
class Part:
    """A path and the ranges given for it alone; None where it was not said.

    Parameters
    ----------
    path : of sequences
    database, queries : ranges over the frames of all its sequences, in order
    """

    path: Path
    database: Ranges | None = None
    queries: Ranges | None = None


@dataclass(frozen=True, eq=False)
class Chosen:
    """A frame that takes part.

    Parameters
    ----------
    name : unique in the protocol
    scene : its parent frame; frames of one scene have comparable poses
    use : database, query, or both: what it may find is then limited by the travel between
    reference : where it is
    """

    name: str
    scene: str
    use: Use
    reference: FrameReference

    def is_for(self, use: Use) -> bool:
        """Whether the frame takes part as this."""
        return self.use in (use, "both")


@dataclass(frozen=True, eq=False)
class Protocol:
    """The frames of an evaluation.

    Parameters
    ----------
    frames : database and queries, in the order given
    split : whether they come from TrainSplit.txt and TestSplit.txt: the paper's 7-Scenes table
    """

    frames: tuple[Chosen, ...]
    split: bool


def parse_ranges(text: str) -> Ranges:
    """Ranges such as 0:600, 0:600:2, 650: or 0:25+50:75.

    Raises
    ------
    DatasetError : it is none of these, a range is empty, or its step is 0.
    """
    found = []
    for one in text.split("+"):
        match = _RANGE.fullmatch(one.strip())
        if match is None:
            raise DatasetError(
                f"{text!r} is no range of frames. Write START:STOP or START:STOP:STEP, such as "
                "0:600:2, and join several with +, such as 0:25+50:75."
            )
        start, stop, step = (None if part is None else int(part) for part in match.groups())
        if step == 0 or (stop is not None and stop <= (start or 0)):
            raise DatasetError(
                f"{text!r} holds no frame. STOP must exceed START, and STEP be 1 up."
            )
        found.append(Range(start, stop, step))
    return tuple(found)


def parse_part(text: str) -> Part:
    """A PATH, or PATH@db=RANGES,queries=RANGES with either of the two.

    Raises
    ------
    DatasetError : what follows the @ is not of this form.
    """
    match = _OWN_RANGES.fullmatch(text)
    if match is None:
        return Part(Path(text))
    own: dict[str, Ranges] = {}
    for one in match[2].split(","):
        key, _, ranges = one.partition("=")
        if key not in ("db", "queries") or key in own:
            raise DatasetError(
                f"{text}: {one!r} is not understood. Write PATH@db=0:600:2,queries=650:1000:2."
            )
        own[key] = parse_ranges(ranges)
    return Part(Path(match[1]), own.get("db"), own.get("queries"))


def choose(
    parts: Sequence[Part],
    distractors: Sequence[Path] = (),
    *,
    database: Ranges | None = None,
    queries: Ranges | None = None,
    database_step: int = 1,
    query_step: int = 1,
    shared: bool = False,
) -> Protocol:
    """Tell the frames of each path to the database or the queries; no frame is read.

    A path's own ranges go before `database` and `queries`, and these before the split files of
    its scenes.

    Parameters
    ----------
    parts : paths, with ranges of their own or without
    distractors : paths of which every frame is in the database
    database, queries : for paths without ranges of their own
    database_step, query_step : take every so manieth frame, where a range says no step itself
    shared : a frame may be both, and paths without ranges are, as a whole, both

    Raises
    ------
    DatasetError : nothing says what is database and what query, a range lies outside its path,
        a frame is chosen twice, two scenes have one name, or there is no query.
    """
    gathered = _Gathered(shared=shared)
    every = (Range(None, None, None),)
    splits = []
    for part in parts:
        of_db, of_queries = part.database, part.queries
        if of_db is None and of_queries is None:
            of_db, of_queries = database, queries
            if shared:
                of_db, of_queries = of_db or every, of_queries or every
        splits.append(of_db is None and of_queries is None)
        if splits[-1]:
            gathered.add_split(part.path, database_step, query_step)
            continue
        gathered.add_ranges(part.path, of_db or (), "database", database_step)
        gathered.add_ranges(part.path, of_queries or (), "query", query_step)
    for path in distractors:
        gathered.add_ranges(path, every, "database", 1)
    frames = tuple(gathered.frames.values())
    wanted: tuple[tuple[Use, str], ...] = (
        ("query", "--queries"),
        ("database", "--db or --distractors"),
    )
    for use, option in wanted:
        if not any(frame.is_for(use) for frame in frames):
            raise DatasetError(
                f"No frame is chosen as {use}, so there is nothing to measure. Add {option}."
            )
    return Protocol(frames, all(splits))


def every_frame(paths: Sequence[Path]) -> tuple[Chosen, ...]:
    """All frames of all paths, in order, each as a query; no frame is read.

    Raises
    ------
    DatasetError : a frame is there twice, or two scenes have one name.
    """
    places = [path.resolve() for path in paths]
    for i, place in enumerate(places):
        for j in range(i):
            if place.is_relative_to(places[j]) or places[j].is_relative_to(place):
                raise DatasetError(
                    f"{paths[i]}: Its frames are those of {paths[j]} too. Give each path once."
                )
    gathered = _Gathered()
    for path in paths:
        gathered.add_ranges(path, (Range(None, None, None),), "query", 1)
    return tuple(gathered.frames.values())


class _Gathered:
    """Frames so far, by the file they are in."""

    def __init__(self, *, shared: bool = False) -> None:
        self._shared = shared
        self.frames: dict[Path, Chosen] = {}
        self._names: set[str] = set()
        self._places: dict[str, Path] = {}

    def add_split(self, path: Path, database_step: int, query_step: int) -> None:
        sequences = find_sequences(path)
        if not any(s.split for s in sequences):
            raise DatasetError(
                f"{path}: Nothing says which frames are the database and which the queries. "
                "Give --db and --queries, such as --db 0:600 --queries 650:1000, or put "
                "TrainSplit.txt and TestSplit.txt beside the sequences."
            )
        for scene in dict.fromkeys(s.parent_frame for s in sequences):
            own = [s for s in sequences if s.parent_frame == scene]
            train = [(s, f) for s in own if s.split == "train" for f in s.frames]
            test = [(s, f) for s in own if s.split == "test" for f in s.frames]
            self._add(path, train[::database_step], "database")
            self._add(path, test[::query_step], "query")

    def add_ranges(self, path: Path, ranges: Iterable[Range], use: Use, step: int) -> None:
        every = [(s, f) for s in find_sequences(path) for f in s.frames]
        for one in ranges:
            if (one.start or 0) >= len(every) or (one.stop or 0) > len(every):
                raise DatasetError(
                    f"{path}: The range {one} lies outside its {len(every)} frames. "
                    f"Choose from 0:{len(every)}."
                )
            self._add(path, every[one.start : one.stop : one.step or step], use)

    def _add(self, path: Path, new: list[tuple[Run, FrameReference]], use: Use) -> None:
        for run, reference in new:
            scene, file = run.parent_frame, reference.path.resolve()
            place = run.folder if run.name == scene else run.folder.parent
            if self._places.setdefault(scene, place.resolve()) != place.resolve():
                raise DatasetError(
                    f"{path}: Another scene is called {scene} too, {self._places[scene]}. "
                    "Rename one of the folders."
                )
            known = self.frames.get(file)
            if known is not None and self._shared and known.use != use:
                self.frames[file] = replace(known, use="both")
                continue
            if known is not None:
                raise DatasetError(
                    f"{path}: {reference.name} is chosen twice, as {known.use} and as "
                    f"{use}. A frame must not be asked for itself: give ranges that do not meet."
                )
            own = reference.name.startswith(f"{scene}/")
            name = reference.name if own else f"{scene}/{reference.name}"
            if name in self._names:
                raise DatasetError(f"{path}: Two frames are called {name}. Rename one of them.")
            self._names.add(name)
            self.frames[file] = Chosen(name, scene, use, reference)
