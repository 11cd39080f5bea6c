"""Tests of decoder processes: equal arrays, isolation, limits, replacement and fairness."""

import errno
import os
import select
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint import errors
from sceneprint.decoders import LocalDecoders
from sceneprint.decoders.child_process import _image_samples, array_samples, text_samples
from sceneprint.decoders.pool import DecoderPool
from sceneprint.decoders.sandbox import filter_program
from sceneprint.process import set_tenant, work_of
from sceneprint_client.sidecars import UNSAID

HERE = Path(__file__).resolve().parent
#: Memory beyond what a process has when it is ready, and processor time of a task.
MORE_BYTES, SECONDS = 256 << 20, 0.5


@pytest.fixture(scope="module")
def pool():
    """One process, which also has the tasks of decoder_tasks.py."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("PYTHONPATH", str(HERE), prepend=os.pathsep)
        pool = DecoderPool(1, MORE_BYTES, SECONDS, program="decoder_tasks")
        yield pool
        pool.close()


def do(pool, task, **request):
    with pool.place() as slot:
        return slot.run({"task": task, **request}, b"", lambda _, said: said)


def await_end(pid):
    try:
        handle = os.pidfd_open(pid)
    except ProcessLookupError:
        return
    try:
        assert select.select([handle], [], [], PATIENCE_S)[0], f"process {pid} lives"
    finally:
        os.close(handle)


def test_arrays_are_the_same_as_in_this_process(pool):
    local = LocalDecoders(1)
    with pool.place() as slot:
        for data in _image_samples():
            here, there = local.samples(data), slot.samples(data)
            assert (here.dtype, here.tobytes()) == (there.dtype, there.tobytes())
        for data, form in (*array_samples(), *text_samples()):
            near, far = (one.points(data, form, UNSAID, 0.5) for one in (local, slot))
            assert near.points.tobytes() == far.points.tobytes()
            assert (near.viewpoint, near.file_points) == (far.viewpoint, far.file_points)


def test_a_decoder_reaches_nothing(pool, tmp_path):
    result = do(pool, "escape", path=str(tmp_path / "escaped"))
    seccomp = pool.processes()[0].seccomp
    assert seccomp == Path("/proc/sys/kernel/seccomp/actions_avail").exists()
    if not seccomp:
        pytest.skip("this kernel has no seccomp")
    assert result == dict.fromkeys(
        ("socket", "read", "write", "fork", "exec", "signal", "list"), errno.EPERM
    )
    assert list(tmp_path.iterdir()) == []


def test_a_crash_is_an_error_of_the_upload_and_the_process_is_replaced(pool):
    do(pool, "hoard", numbers=1)
    before = pool.processes()[0].pid
    with pytest.raises(errors.DecoderFailure, match=r"crashes the decoder \(signal 11"):
        do(pool, "crash")
    assert do(pool, "hoard", numbers=7) == {"sum": 7.0}
    assert pool.processes()[0].pid != before
    await_end(before)


def test_memory_is_limited(pool):
    assert do(pool, "hoard", numbers=MORE_BYTES // 16) == {"sum": float(MORE_BYTES // 16)}
    with pytest.raises(errors.DecoderFailure, match="more than 256 MiB of memory"):
        do(pool, "hoard", numbers=MORE_BYTES // 4)
    assert do(pool, "hoard", numbers=2) == {"sum": 2.0}


@pytest.mark.parametrize(
    ("task", "reason"), [("hang", r"longer than 0\.5 s"), ("sleep", r"idle for 0\.5 s")]
)
def test_time_is_limited_of_work_and_of_sleep(pool, task, reason):
    with pytest.raises(errors.DecoderFailure, match=reason):
        do(pool, task)
    assert do(pool, "hoard", numbers=3) == {"sum": 3.0}


def test_freed_memory_holds_nothing_of_an_upload(pool):
    size = 1 << 20  # which the process keeps
    assert do(pool, "leave", numbers=size)["sum"] == 77 * size
    assert do(pool, "look", numbers=size)["seen"] < 1000


def test_a_bug_is_not_an_error_of_the_upload(pool):
    with pytest.raises(RuntimeError, match="ZeroDivisionError: a bug of ours"):
        do(pool, "fail")


@pytest.mark.parametrize(
    "reply",
    [
        {"type": "<u2", "shape": [1 << 20, 1 << 20]}, {"type": "|O", "shape": [2, 2]},
        {"type": "<u2", "shape": [-1, 2]}, {"type": "<u2", "shape": "22"}, {},
    ],
)  # fmt: skip
def test_a_reply_that_lies_is_no_result(pool, reply, monkeypatch):
    do(pool, "hoard", numbers=1)
    with pool.place() as slot:
        process = slot.process
        assert process is not None
        monkeypatch.setattr(type(process), "ask", lambda *_: reply)
        with pytest.raises(errors.DecoderFailure, match="its reply is invalid"):
            slot.samples(_image_samples()[0])


def test_processes_end_with_the_pool_and_with_a_killed_parent():
    pool = DecoderPool(2, 0, 10.0)
    pool.start()
    pid = pool.processes()[0].pid
    pool.close()
    await_end(pid)
    program = (
        "from sceneprint.decoders.pool import DecoderPool\n"
        "pool = DecoderPool(1, 0, 10.0); pool.start()\n"
        "print(pool.processes()[0].pid, flush=True); input()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as parent:
        child = int(parent.stdout.readline())
        os.kill(parent.pid, signal.SIGKILL)
        parent.wait()
    await_end(child)


def test_a_tenant_alone_has_all_places_and_beside_another_half():
    pool = DecoderPool(4, 0, 10.0)
    held = [pool.place() for _ in range(4)]
    with work_of("a"):
        for one in held:
            one.__enter__()
    begun, served, release = threading.Event(), threading.Event(), threading.Event()

    def other():
        set_tenant("b")
        begun.set()
        with pool.place():
            served.set()
            release.wait(PATIENCE_S)

    thread = threading.Thread(target=other)
    thread.start()
    assert begun.wait(PATIENCE_S)
    assert not served.is_set()
    held.pop().__exit__(None, None, None)  # goes to b, though a might ask first
    assert served.wait(PATIENCE_S)
    # a holds three of four, more than half: a place that b gives back is not for a
    done = threading.Event()

    def again():
        set_tenant("a")
        with pool.place():
            done.set()

    waiting = threading.Thread(target=again)
    waiting.start()
    release.set()
    thread.join(PATIENCE_S)
    assert not done.is_set()
    held.pop().__exit__(None, None, None)
    held.pop().__exit__(None, None, None)
    assert done.wait(PATIENCE_S)
    waiting.join(PATIENCE_S)
    held.pop().__exit__(None, None, None)
    pool.close()


@pytest.mark.parametrize("machine", ["x86_64", "aarch64"])
def test_the_filter_decides_as_its_list_says(machine):
    architecture = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}[machine]
    run = interpreter(filter_program(machine))
    allow, refuse, kill = 0x7FFF0000, 0x00050001, 0x80000000
    read, openat, socket_, mmap = {
        "x86_64": (0, 257, 41, 9), "aarch64": (63, 56, 198, 222)
    }[machine]  # fmt: skip
    assert run(read, architecture, 0) == allow
    assert run(openat, architecture, 0) == run(socket_, architecture, 0) == refuse
    assert run(mmap, architecture, 3) == allow  # to read and write
    assert run(mmap, architecture, 4) == run(mmap, architecture, 7) == refuse  # to execute
    assert run(read, architecture ^ 1, 0) == kill
    assert run(read | 0x40000000, architecture, 0) == kill


def interpreter(program):
    """What a program of classic BPF returns for (number, architecture, third argument)."""

    def run(number, architecture, third):
        words, at, value = {0: number, 4: architecture, 32: third}, 0, 0
        while True:
            code, true, false, k = program[at]
            at += 1
            if code == 0x06:
                return k
            if code == 0x20:
                value = words[k]
                continue
            holds = {0x15: value == k, 0x35: value >= k, 0x45: bool(value & k)}[code]
            at += true if holds else false

    return run


def test_samples_come_back_in_the_size_of_a_large_image(pool):
    from sceneprint.formats.depth_file import encode_png

    depth = np.arange(4_000_000, dtype=np.uint16).reshape(2000, 2000)
    with pool.place() as slot:
        assert np.array_equal(slot.samples(encode_png(depth)), depth)
        assert slot.samples(_image_samples()[0]).shape == (2, 2)
        pfm = b"Pf\n2 2\n-1\n" + np.arange(4, dtype="<f4").tobytes()
        np.testing.assert_array_equal(slot.samples(pfm), [[2, 3], [0, 1]])
