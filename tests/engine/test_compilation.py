"""Tests of kernels that separate processes compile ahead of the first frame."""

import os
import signal
import subprocess
import sys
import threading
from importlib.resources import files
from pathlib import Path

import pytest

from sceneprint.engine import compilation
from sceneprint.engine.compilation import ALL, DEPTH, compile_kernels
from sceneprint.engine.signers import warm_signing, warm_validation
from sceneprint.formats.artifact import read_geometry
from sceneprint.geometry.kernel import TARGET, TARGET_FEATURES, runs_here
from sceneprint.models import read_model
from sceneprint.settings import Settings
from sceneprint.signing import open_signer

#: A stand-in of the process that compiles a part.
SLOW, FAILING = "import time; time.sleep(60)", "raise SystemExit(3)"


@pytest.fixture
def told_to(monkeypatch):
    """Has every part missing, and the first argument run in place of what compiles it."""
    started = []
    begin = subprocess.Popen

    def instead(command, **given):
        program = SLOW if command[4] == "slow" else FAILING
        started.append(begin([sys.executable, "-c", program]))
        return started[-1]

    monkeypatch.setattr(compilation, "missing", tuple)
    monkeypatch.setattr(compilation.subprocess, "Popen", instead)
    return started


def test_who_is_told_to_stop_leaves_no_process(told_to):
    stop, said = threading.Event(), list[str]()
    threading.Timer(0.3, stop.set).start()
    compile_kernels(Path("slow"), DEPTH, said.append, stop)
    assert [process.returncode for process in told_to] == 2 * [-signal.SIGTERM]
    assert len(said) == 1  # nothing is finished


def test_a_process_that_fails_is_told_of_and_costs_no_more(told_to):
    said = []
    compile_kernels(Path("failing"), ALL, said.append)
    assert len(told_to) == 3
    failed = [one for one in said if "not compiled (exit code 3); they are" in one]
    assert sorted(one.split()[2] for one in failed) == ["clouds", "signing", "validation"]
    assert said[-1].startswith("compilation finished in ")


@pytest.mark.skipif(not runs_here(), reason="an older processor, or none of x86")
@pytest.mark.parametrize(
    ("named", "expected"),
    [
        (None, (TARGET, TARGET_FEATURES)),
        ("", (TARGET, TARGET_FEATURES)),
        ("nehalem", ("nehalem", None)),
    ],
)
def test_code_is_for_all_processors_unless_one_is_named(monkeypatch, named, expected):
    if named is None:
        monkeypatch.delenv("NUMBA_CPU_NAME", raising=False)
    else:
        monkeypatch.setenv("NUMBA_CPU_NAME", named)
    monkeypatch.delenv("NUMBA_CPU_FEATURES", raising=False)
    begin, found = subprocess.Popen, []

    def instead(command, *, env, **_):
        found.append((env["NUMBA_CPU_NAME"], env.get("NUMBA_CPU_FEATURES")))
        return begin([sys.executable, "-c", ""])

    monkeypatch.setattr(compilation, "missing", tuple)
    monkeypatch.setattr(compilation.subprocess, "Popen", instead)
    compile_kernels(Path("nowhere"), DEPTH)
    assert found == [expected, expected]


def test_the_corner_is_what_signing_leaves_of_it():
    """Or validation would be compiled for another kind of geometry than it gets."""
    kept = files("sceneprint.engine").joinpath("corner.artifact").read_bytes()
    model = read_model("depth")
    signer = open_signer(model, Settings().cache_dir)
    assert warm_signing(signer) == kept
    assert warm_validation(read_geometry(kept), model.parameters.validation)


#: Signs, searches and validates, then says how many kernels of ours were compiled and loaded.
COUNT = """
import gc, sys
from pathlib import Path
from sceneprint.engine.signers import warm
from sceneprint.signing import open_signer
assert warm(open_signer("depth", Path(sys.argv[1])), clouds=sys.argv[2] == "clouds")
from numba.core.dispatcher import Dispatcher
ours = [one for one in gc.get_objects() if isinstance(one, Dispatcher)
        and one.py_func.__module__.startswith("sceneprint.")]
print(sum(sum(one._cache_misses.values()) for one in ours),
      sum(sum(one._cache_hits.values()) for one in ours))
"""


@pytest.mark.thorough
def test_whoever_comes_after_compiles_nothing(tmp_path, monkeypatch):
    """But for what both processes compile: each writes the list of it, and one may be lost."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "numba"))
    program = (
        "import sys; from pathlib import Path; from sceneprint.engine.compilation import *;"
        "from sceneprint.engine.compilation import ALL, DEPTH, compile_kernels, missing;"
        "compile_kernels(Path(sys.argv[1]), ALL if sys.argv[2] == 'clouds' else DEPTH);"
        "print(missing(ALL))"
    )
    for what, left in (("depth", "('clouds',)"), ("clouds", "()")):
        command = [sys.executable, "-c", program, str(tmp_path), what]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        assert done.stdout.strip() == left
        command = [sys.executable, "-c", COUNT, str(tmp_path), what]
        done = subprocess.run(
            command, capture_output=True, text=True, check=True, env=dict(os.environ)
        )
        compiled, loaded = map(int, done.stdout.split())
        assert compiled <= 2
        assert loaded > 25
