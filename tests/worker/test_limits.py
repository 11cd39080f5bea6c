"""Tests of a worker's limits, its termination, and its remains."""

import os
import subprocess
import sys

import pytest

from sceneprint.errors import LostLease
from worker.loop import HEAD, Trace


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
