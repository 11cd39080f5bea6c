"""Tests of backups and restores that are killed: bundles are complete, and restores continue."""

import random
import subprocess
import sys
import time

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.bundle.backup import take_backup
from sceneprint.bundle.place import BundlePlace
from sceneprint.bundle.restoration import restore_to_folder, verify_bundle

KILLS = 12

#: Forks a child for every line it reads, which does it without end, and kills it on the next: to
#: import once is what makes many deaths affordable.
NURSERY = """
import itertools, os, signal, sys
from pathlib import Path
from sceneprint.bundle.backup import take_backup
from sceneprint.bundle.restoration import restore_to_folder
from sceneprint.settings import Settings

what, source, folder = sys.argv[1], sys.argv[2], Path(sys.argv[3])
settings = Settings(data_dir=Path(source), database_url=None)
for life, line in enumerate(sys.stdin):
    child = os.fork()
    if child == 0:
        for n in itertools.count():
            if what == "snapshot":
                take_backup(settings, str(folder / f"{life}-{n % 2}"))
            else:
                restore_to_folder(source, folder / f"{life}-{n}")
    print(child, flush=True)
    sys.stdin.readline()
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    print("dead", flush=True)
"""


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["snapshot", "restore"])
def test_killed_at_any_moment(kind, master, place, tmp_path, content, settings):
    source = str(master) if kind == "snapshot" else place
    delays = random.Random(6)
    with subprocess.Popen(
        [sys.executable, "-c", NURSERY, kind, source, str(tmp_path)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1,
    ) as nursery:  # fmt: skip
        for life in range(KILLS):
            nursery.stdin.write("born\n")
            assert int(nursery.stdout.readline()) > 0
            waited = time.monotonic()
            while not (tmp_path / f"{life}-0").exists():  # it has begun, and goes on
                assert time.monotonic() - waited < PATIENCE_S
                time.sleep(0.002)
            time.sleep(delays.uniform(0, 0.15))
            nursery.stdin.write("die\n")
            assert nursery.stdout.readline() == "dead\n"
        nursery.stdin.close()
    restore_to_folder(place, tmp_path / "sound")
    expected = content(tmp_path / "sound")
    found = sorted(one for one in tmp_path.iterdir() if one.name[0].isdigit())
    assert len(found) >= KILLS
    unfinished = 0
    for folder in found:
        if kind == "snapshot":
            names = BundlePlace.open(str(folder)).names()
            unfinished += not names
            for name in names:
                assert verify_bundle(str(folder), name).manifest.blobs == 9
            take_backup(settings(master), str(folder))
            assert verify_bundle(str(folder)).manifest.blobs == 9
            continue
        if not (folder / "sceneprint.db").exists():
            unfinished += 1
            restore_to_folder(place, folder)
        assert content(folder) == expected
        assert not (folder / ".restoring").exists() or unfinished
    assert unfinished  # some died in the middle
