"""Tests of builders that are killed or run in parallel, and of concurrent readers."""

import random
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.index.index_manifest import newest_number
from sceneprint.index.index_version import (
    Tail,
    newest,
    publish,
    search,
    signatures_of,
)

LENGTH, STEP = 512, 25

#: Publishes without end in a child of its own, and forks another for every line it reads: to
#: import once is what makes many deaths affordable. FAISS runs in children only.
NURSERY = """
import os, signal, sys
from pathlib import Path
import faiss
import numpy as np
from sceneprint.index.index_version import newest, publish

folder = Path(sys.argv[1])
LENGTH, STEP = 512, 25

def signatures(keys):
    return np.stack([np.random.default_rng(k).integers(0, 256, LENGTH, np.uint8) for k in keys])

for line in sys.stdin:
    child = os.fork()
    if child == 0:
        while True:
            before = newest(folder, "model", LENGTH)
            n = 0 if before is None else len(before)
            keys = np.arange(n, n + STEP)
            publish(folder, model_id="model", revision=n + STEP,
                    blocks=[(keys, signatures(keys))], previous=before)
    print(child, flush=True)
    sys.stdin.readline()
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    print("dead", flush=True)
"""


def deadline(process, seconds=120):
    """Kill a process that has not done in that time, so that nobody waits for it any more."""
    timer = threading.Timer(seconds, process.kill)
    timer.start()
    return timer


def signatures_at(keys):
    return np.stack([np.random.default_rng(k).integers(0, 256, LENGTH, np.uint8) for k in keys])


def is_whole(version):
    """Whether a version holds the first `revision` frames, and nothing else."""
    n = version.revision
    np.testing.assert_array_equal(version.keys, np.arange(n))
    assert len(version) == n
    keys = np.arange(0, n, 7)
    stored = signatures_of(keys, version, Tail.empty(LENGTH))
    np.testing.assert_array_equal(stored, signatures_at(keys))
    return True


@pytest.mark.thorough
def test_a_builder_killed_at_any_moment(tmp_path):
    delays, revision, unfinished = random.Random(4), 0, 0
    with subprocess.Popen(
        [sys.executable, "-c", NURSERY, str(tmp_path)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1,
    ) as nursery:  # fmt: skip
        timer = deadline(nursery)
        for _ in range(12):
            nursery.stdin.write("born\n")
            assert int(nursery.stdout.readline()) > 0
            before = newest_number(tmp_path) or 0
            waited = time.monotonic()
            while newest_number(tmp_path) in (None, before):  # it has begun, and goes on
                assert time.monotonic() - waited < PATIENCE_S
                time.sleep(0.002)
            time.sleep(delays.uniform(0, 0.08))
            nursery.stdin.write("die\n")
            assert nursery.stdout.readline() == "dead\n"
            found = newest(tmp_path, "model", LENGTH)
            assert found.revision > revision
            assert is_whole(found)
            revision = found.revision
            unfinished += bool(list(tmp_path.glob(".*.part")))
        nursery.stdin.close()
        nursery.wait()
        timer.cancel()
    assert unfinished  # some died with a file half written
    again = publish(
        tmp_path, model_id="model", revision=revision + 1, previous=found,
        blocks=[(np.array([revision]), signatures_at(np.array([revision])))],
    )  # fmt: skip
    assert again is not None
    assert is_whole(again)
    assert not list(tmp_path.glob(".*.part"))


def test_readers_go_on_while_versions_pass(walk, published, tmp_path):
    """Threads search an old version while its files are removed, others follow the newest."""
    folder, signatures = tmp_path / "map", walk(750, LENGTH)
    first = published(np.arange(300), signatures[:300], revision=300)
    old = {path.name for path in folder.iterdir()}
    tail, errors, done = Tail.empty(LENGTH), [], threading.Event()
    queries = signatures[::97]
    expected = [search(q, first, tail, 20, metric="l2") for q in queries]
    counts = [0, 0]

    def search_old():
        while not done.is_set():
            for query, right in zip(queries, expected, strict=True):
                hits = search(query, first, tail, 20, metric="l2")
                if (hits.keys != right.keys).any() or (hits.distances != right.distances).any():
                    errors.append("an old version has changed")
            counts[0] += 1

    def follow():
        known = None
        while not done.is_set():
            found = newest(folder, "model", LENGTH, previous=known)
            if found is None or (known is not None and found.number < known.number):
                errors.append(f"{found and found.number} after {known and known.number}")
                continue
            known = found
            n = known.revision
            hits = search(signatures[n - 1], known, tail, 1, metric="l2")
            if len(known) != n or hits.keys.tolist() != [n - 1]:
                errors.append(f"version {known.number} has {len(known)} of {n}")
            counts[1] += 1

    def guarded(work):
        def run():
            try:
                work()
            except Exception as error:  # what a thread raises would be lost
                errors.append(repr(error))

        return run

    threads = [threading.Thread(target=guarded(w)) for w in (search_old, search_old, follow)]
    for thread in threads:
        thread.start()
    version = first
    for n in range(300, 750, 30):
        new = np.arange(n, n + 30)
        version = published(new, signatures[new], version, revision=n + 30)
    deadline = time.monotonic() + PATIENCE_S
    while min(counts) < 3 and not errors and time.monotonic() < deadline:
        time.sleep(0.01)
    done.set()
    for thread in threads:
        thread.join(PATIENCE_S)
    assert errors == []
    assert min(counts) >= 3
    assert version.number == 16
    left = {path.name for path in folder.iterdir()}
    assert old & left == {".lock"}  # the first segment has been merged
