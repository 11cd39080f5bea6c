"""Tests of kernels that separate processes compile ahead of the first frame."""

import subprocess
import sys
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


@pytest.fixture
def told_to(monkeypatch):
    """Has every part missing; returns the environments of the processes that compile them."""
    started, begin = [], subprocess.Popen

    def instead(_, *, env, **__):
        started.append(env)
        return begin([sys.executable, "-c", ""])

    monkeypatch.setattr(compilation, "missing", tuple)
    monkeypatch.setattr(compilation.subprocess, "Popen", instead)
    return started


@pytest.mark.skipif(not runs_here(), reason="an older processor, or none of x86")
@pytest.mark.parametrize(
    ("named", "expected"), [("", (TARGET, TARGET_FEATURES)), ("nehalem", ("nehalem", None))]
)
def test_code_is_for_all_processors_unless_one_is_named(told_to, monkeypatch, named, expected):
    monkeypatch.setenv("NUMBA_CPU_NAME", named)
    monkeypatch.delenv("NUMBA_CPU_FEATURES", raising=False)
    compile_kernels(Path("nowhere"), DEPTH)
    found = [(one["NUMBA_CPU_NAME"], one.get("NUMBA_CPU_FEATURES")) for one in told_to]
    assert found == [expected, expected]


def test_the_corner_is_what_signing_leaves_of_it():
    """Or validation would be compiled for another kind of geometry than it gets."""
    kept = files("sceneprint.engine").joinpath("corner.artifact").read_bytes()
    model = read_model("depth")
    signer = open_signer(model, Settings().cache_dir)
    assert warm_signing(signer) == kept
    assert warm_validation(read_geometry(kept), model.parameters.validation)
