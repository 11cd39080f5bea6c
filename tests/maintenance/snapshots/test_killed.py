"""Snapshots and restores that are killed: the whole of it is there, or nothing is."""

from __future__ import annotations

import random
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.maintenance.snapshot.creation import take_snapshot
from sceneprint.maintenance.snapshot.restoration import restore_snapshot, verify_snapshot

KILLS = 12

#: Forks a child for every line it reads, which does it without end, and kills it on the next: to
#: import once is what makes many deaths affordable.
NURSERY = """
import itertools, os, signal, sys
from pathlib import Path
from sceneprint.maintenance.snapshot.restoration import restore_snapshot
from sceneprint.maintenance.snapshot.creation import take_snapshot
from sceneprint.settings import Settings

what, source, folder = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
settings = Settings(data_dir=source, database_url=None)
for life, line in enumerate(sys.stdin):
    child = os.fork()
    if child == 0:
        for n in itertools.count():
            if what == "snapshot":
                take_snapshot(settings, folder / f"{life}-{n}.tar")
            else:
                restore_snapshot(source, folder / f"{life}-{n}")
    print(child, flush=True)
    sys.stdin.readline()
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    print("dead", flush=True)
"""


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@contextmanager
def killed(what: str, source: Path, folder: Path) -> Iterator[list[int]]:
    """Let it die at as many moments; yields how many it had made each time."""
    delays, made = random.Random(6), []
    with subprocess.Popen(
        [sys.executable, "-c", NURSERY, what, str(source), str(folder)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1,
    ) as nursery:  # fmt: skip
        assert nursery.stdin is not None
        assert nursery.stdout is not None
        for life in range(KILLS):
            nursery.stdin.write("born\n")
            assert int(nursery.stdout.readline()) > 0
            waited = time.monotonic()
            first = (folder / f"{life}-0", folder / f"{life}-0.tar")
            while not any(path.exists() for path in first):  # it has begun, and goes on
                assert time.monotonic() - waited < PATIENCE_S
                time.sleep(0.002)
            time.sleep(delays.uniform(0, 0.15))
            nursery.stdin.write("die\n")
            assert nursery.stdout.readline() == "dead\n"
            made.append(len([one for one in names_in(folder) if one.startswith(f"{life}-")]))
        nursery.stdin.close()
    yield made


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["snapshot", "restore"])
def test_killed_at_any_moment(kind, master, archive, tmp_path, content, settings):
    hidden = ".sceneprint-snapshot-" if kind == "snapshot" else ".restoring-"
    source = master if kind == "snapshot" else archive
    with killed(kind, source, tmp_path) as made:
        assert all(made)
    left = [one for one in names_in(tmp_path) if hidden in one]
    whole = [one for one in names_in(tmp_path) if hidden not in one]
    assert len(whole) >= KILLS
    assert left  # some died in the middle
    restore_snapshot(archive, tmp_path / "sound")
    expected = content(tmp_path / "sound")
    for name in whole:
        if kind == "snapshot":
            assert verify_snapshot(tmp_path / name).manifest.blobs.count == 9
        else:
            assert content(tmp_path / name) == expected
    if kind == "snapshot":  # the next one clears away what any has left
        take_snapshot(settings(master), tmp_path / "again.tar")
        assert not [one for one in names_in(tmp_path) if hidden in one]
    else:  # the next one to the same place
        name = left[0].partition(hidden)[0]
        restore_snapshot(archive, tmp_path / name)
        assert not list(tmp_path.glob(f"{name}{hidden}*"))
        assert content(tmp_path / name) == expected
