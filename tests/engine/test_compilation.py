"""Tests of kernels that separate processes compile ahead of the first frame."""

import signal
import subprocess
import sys
import threading
from importlib.resources import files
from pathlib import Path

import pytest

from sceneprint.engine import compilation
from sceneprint.engine.compilation import DEPTH, compile_kernels
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
    started, begin = [], subprocess.Popen

    def instead(command, *, env=None, **_):
        program = SLOW if command[4] == "slow" else FAILING
        started.append(begin([sys.executable, "-c", program]))
        started[-1].told = env
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


@pytest.mark.skipif(not runs_here(), reason="an older processor, or none of x86")
@pytest.mark.parametrize(
    ("named", "expected"), [("", (TARGET, TARGET_FEATURES)), ("nehalem", ("nehalem", None))]
)
def test_code_is_for_all_processors_unless_one_is_named(told_to, monkeypatch, named, expected):
    monkeypatch.setenv("NUMBA_CPU_NAME", named)
    monkeypatch.delenv("NUMBA_CPU_FEATURES", raising=False)
    compile_kernels(Path("failing"), DEPTH)
    found = [(one.told["NUMBA_CPU_NAME"], one.told.get("NUMBA_CPU_FEATURES")) for one in told_to]
    assert found == [expected, expected]


def test_the_corner_is_what_signing_leaves_of_it():
    """Or validation would be compiled for another kind of geometry than it gets."""
    kept = files("sceneprint.engine").joinpath("corner.artifact").read_bytes()
    model = read_model("depth")
    signer = open_signer(model, Settings().cache_dir)
    assert warm_signing(signer) == kept
    assert warm_validation(read_geometry(kept), model.parameters.validation)
