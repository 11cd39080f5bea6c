"""Tests of a worker's limits, its termination, and its remains."""

import os
import signal
import subprocess
import sys

import pytest

from sceneprint.errors import LostLease
from worker.loop import HEAD, TAIL, Trace


def run(code, *arguments):
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


MEMORY = """
import sys
import numpy as np
from sceneprint.process import limit_memory
limit_memory(int(sys.argv[1]))
small = np.ones(16 << 20, np.uint8)
mapped = np.memmap(sys.argv[2], np.uint8, mode="r")
assert int(mapped[::4096].sum()) == 0
try:
    np.ones(256 << 20, np.uint8)
    print("had it")
except MemoryError:
    print("not enough memory")
"""


@pytest.mark.parametrize(("limit", "said"), [(128 << 20, "not enough memory"), (0, "had it")])
def test_what_is_written_is_limited_and_what_is_mapped_is_not(tmp_path, limit, said):
    with (tmp_path / "table").open("wb") as file:
        file.truncate(512 << 20)
    assert run(MEMORY, str(limit), str(tmp_path / "table")) == said


STOP = """
import os, signal, sys
from sceneprint.process import StopSignal
stop = StopSignal()
print(stop.requested)
os.kill(os.getpid(), int(sys.argv[1]))
stop.wait(1e6)
print(stop.requested)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_wait(number):
    assert run(STOP, str(int(number))).split() == ["False", "True"]


def test_a_job_that_is_done_leaves_nothing():
    trace = Trace()
    assert (trace.read().job_id, trace.read().text) == (None, "")
    with trace.job("ab", 3, 600.0):
        assert (trace.read().job_id, trace.read().token, trace.read().text) == ("ab", 3, "")
    assert (trace.read().job_id, trace.read().text) == (None, "")
    with pytest.raises(LostLease), trace.job("cd", 4, 600.0):
        raise LostLease("said on purpose")
    assert (trace.read().job_id, trace.read().text) == (None, "")
    trace.close()


def test_an_error_that_ends_the_worker_leaves_its_traceback():
    trace = Trace()
    with pytest.raises(MemoryError), trace.job("ab" * 16, 12, 600.0):
        raise MemoryError("all of it")
    left = trace.read()
    assert (left.job_id, left.token, left.timed_out) == ("ab" * 16, 12, False)
    assert left.text.startswith("Traceback (most recent call last):\n")
    assert left.text.endswith("MemoryError: all of it\n")
    trace.close()


def test_of_a_long_traceback_the_end_is_kept():
    trace = Trace()
    with pytest.raises(ValueError, match="end"), trace.job("ab", 1, 600.0):
        raise ValueError("x" * (2 * TAIL) + "the end")
    left = trace.read()
    assert (left.job_id, left.token, len(left.text)) == ("ab", 1, TAIL)
    assert left.text.endswith("xthe end\n")
    trace.close()


def test_a_crash_of_no_job_is_not_mistaken_for_one():
    trace = Trace()
    os.write(trace._descriptor, b"Fatal Python error: Segmentation fault\n" + b"x" * HEAD)
    assert trace.read().job_id is None
    assert trace.read().text.startswith("Fatal Python error")
    trace.close()


TIMEOUT = """
import ctypes, sys
from worker.loop import Trace
trace = Trace()
import os
os.dup2(int(sys.argv[1]), trace._descriptor)
def stuck():
    ctypes.PyDLL(None).sleep(600)  # never gives the interpreter back
with trace.job("ab", 7, 0.3):
    stuck()
"""


def test_code_that_never_gives_the_interpreter_back_is_ended():
    trace = Trace()
    own = trace._descriptor
    done = subprocess.run([sys.executable, "-c", TIMEOUT, str(own)], pass_fds=[own], check=False)
    left = trace.read()
    assert (done.returncode, left.job_id, left.token, left.timed_out) == (1, "ab", 7, True)
    assert "in stuck" in left.text
    trace.close()
