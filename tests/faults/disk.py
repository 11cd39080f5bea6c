"""Simulation of a disk that loses power, with all outcomes that POSIX allows.

From a log of calls the simulation creates the possible folders after each step:

* The content of a file is durable as of its last fsync. Later writes may be complete, partial or
  missing.
* A created, changed or removed name is durable once its folder is synced. Before that, each change
  may be missing, independently of the others.
* A rename within a folder is one change; a rename between folders is two.
"""

from __future__ import annotations

import os
import random
import stat
import threading
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path

#: A change of a folder: names and their new targets, None for a removed name.
Change = dict[str, int | None]


@dataclass
class Inode:
    """A file or a folder, with its visible and its durable content."""

    is_folder: bool
    seen: bytes = b""
    sure: bytes = b""
    names: dict[str, int] = field(default_factory=dict)
    sure_names: dict[str, int] = field(default_factory=dict)
    pending: list[Change] = field(default_factory=list)


class Disk:
    """The log of one folder as a sequence of disk states.

    Parameters
    ----------
    root : folder, whose initial content is durable
    deaf : "files" or "folders", whose fsyncs this disk ignores, so that a test must fail
    """

    def __init__(self, root, deaf=""):
        self.root, self.deaf = root.resolve(), deaf
        self._lock = threading.RLock()  # a restore writes in several threads
        self.inodes: dict[int, Inode] = {}
        self.states: list[tuple[str, dict[int, Inode]]] = []
        self._ids: dict[int, int] = {}  # for files with a name, since inode numbers are reused
        self._top = self._new(self.root.stat().st_ino, is_folder=True)
        self._look()
        for inode in self.inodes.values():
            inode.sure, inode.sure_names, inode.pending = inode.seen, dict(inode.names), []
        self._keep("begin")

    def _new(self, real, *, is_folder):
        self._ids[real] = len(self.inodes)
        self.inodes[self._ids[real]] = Inode(is_folder)
        return self._ids[real]

    def mark(self, what):
        """Record an event elsewhere, such as a commit."""
        with self._lock:
            self._look()
            self._keep(what)

    def synced(self, descriptor):
        """Record an fsync."""
        with self._lock:
            self._note_sync(os.fstat(descriptor))

    def _note_sync(self, found):
        self._look()
        if found.st_ino not in self._ids or found.st_dev != self.root.stat().st_dev:
            return
        inode = self.inodes[self._ids[found.st_ino]]
        if stat.S_ISDIR(found.st_mode):
            if self.deaf != "folders":
                inode.sure_names, inode.pending = dict(inode.names), []
            self._keep("sync folder")
        else:
            if self.deaf != "files":
                inode.sure = inode.seen
            self._keep("sync file")

    def about_to(self, event):
        """Record the changes so far, before a call that opens, renames or removes."""
        with self._lock:
            self._look()
            self._keep(f"before {event}")

    def _look(self):
        """Update the visible state from the real folder."""
        with self._lock:
            while True:
                with suppress(FileNotFoundError):  # another thread has moved or removed a file
                    self._read()
                    return

    def _read(self):
        found = {}
        named = {self.root.stat().st_ino}
        for place, _, _ in os.walk(self.root):
            own = found[self._ids[Path(place).stat().st_ino]] = {}
            with os.scandir(place) as entries:
                for each in entries:
                    real, is_folder = each.inode(), each.is_dir()
                    at = self._ids.get(real)
                    if at is None:
                        at = self._new(real, is_folder=is_folder)
                    own[each.name] = at
                    named.add(real)
                    if not is_folder:
                        self.inodes[at].seen = Path(each.path).read_bytes()
        self._ids = {real: at for real, at in self._ids.items() if real in named}
        for folder, names in found.items():
            inode, changes = self.inodes[folder], []
            gone = {name: at for name, at in inode.names.items() if names.get(name) != at}
            for name, at in names.items():
                if inode.names.get(name) != at:  # with the name that it had here before
                    before = {old: None for old in gone if gone[old] == at and old != name}
                    changes.append({**before, name: at})
            moved = {old for change in changes for old in change}
            inode.pending += [*changes, *({name: None} for name in gone if name not in moved)]
            inode.names = names

    def _keep(self, what):
        self.states.append((what, deepcopy(self.inodes)))

    def sure(self):
        """Return the folder after a crash now that loses all that is not synced; see `crashes`."""
        self._look()
        tree = {}
        self._left(self.inodes, self._top, "", lambda: False, lambda one: one.sure, tree)
        return tree

    def crashes(self, seeds=3):
        """Yield possible folders after a crash at each step, with none, all or some unsynced data.

        Yields
        ------
        step : index of the state
        what : description of the step, and of the data that was kept
        tree : content by path, None for a folder; without repetitions within a step
        """
        for step, (what, inodes) in enumerate(self.states):
            known = []
            ways = [
                ("nothing unsure", lambda: False, lambda one: one.sure),
                ("all", lambda: True, lambda one: one.seen),
                ("names alone", lambda: True, lambda one: one.sure),
                ("names and zeros", lambda: True, _zeros),
            ]
            for seed in range(seeds):
                rng = random.Random(1000 * step + seed)
                ways.append((f"seed {seed}", *_at_random(rng)))
            for how, keeps, content in ways:
                tree = {}
                self._left(inodes, self._top, "", keeps, content, tree)
                if tree not in known:
                    known.append(tree)
                    yield step, f"{what}: {how}", tree

    def _left(self, inodes, number, path, keeps, content, tree):
        names = dict(inodes[number].sure_names)
        for change in inodes[number].pending:
            if keeps():
                names = {k: v for k, v in {**names, **change}.items() if v is not None}
        for name, at in sorted(names.items()):
            inode, place = inodes[at], f"{path}{name}"
            if inode.is_folder:
                tree[place] = None
                self._left(inodes, at, f"{place}/", keeps, content, tree)
            else:
                tree[place] = content(inode)


def _zeros(inode):
    return inode.seen if inode.sure == inode.seen else bytes(len(inode.seen))


def _at_random(rng):
    def content(inode):
        if inode.sure == inode.seen:
            return inode.seen
        kept = rng.choice((0, rng.randrange(len(inode.seen) + 1), len(inode.seen)))
        return rng.choice((inode.sure, inode.seen[:kept]))

    return lambda: rng.random() < 0.5, content
