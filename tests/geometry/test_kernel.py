"""What is kept of compiled kernels: nothing that was made of something else than what is there."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

INNER = """
from sceneprint.geometry.kernel import kernel

{number}

@kernel
def twice(x):
    return {twice}
"""
MIDDLE = """
from inner import twice
from sceneprint.geometry.kernel import kernel


@kernel
def _more(x):
    return twice(x) + 1.0
"""
OUTER = """
from inner import NUMBER
from middle import _more
from sceneprint.geometry.kernel import kernel


@kernel
def outer(x):
    return _more(x) * NUMBER


print(outer(5.0), sum(outer.stats.cache_hits.values()))
"""


def run(folder: Path) -> tuple[float, int]:
    """What the outermost gives of 5, and how often it was loaded and not compiled."""
    environment = {**os.environ, "PYTHONDONTWRITEBYTECODE": "1"}
    environment.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "outer.py"],
        cwd=folder, env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    value, hits = done.stdout.split()
    return float(value), int(hits)


@pytest.mark.parametrize(
    ("number", "twice", "value"),
    [("NUMBER = 10.0", "x * 3", 160.0), ("NUMBER = 7.0", "x * 2", 77.0)],
)
def test_a_caller_is_built_anew_with_what_it_is_made_of(
    tmp_path: Path, number: str, twice: str, value: float
) -> None:
    """A kernel two files away, or a number of another file, which numba does not look at."""
    (tmp_path / "inner.py").write_text(INNER.format(number="NUMBER = 10.0", twice="x * 2"))
    (tmp_path / "middle.py").write_text(MIDDLE)
    (tmp_path / "outer.py").write_text(OUTER)
    assert run(tmp_path) == (110.0, 0)
    assert run(tmp_path) == (110.0, 1)
    (tmp_path / "inner.py").write_text(INNER.format(number=number, twice=twice))
    assert run(tmp_path) == (value, 0)


#: Marks of all kernels that a process has loaded with the library.
MARKS = """
import gc, sceneprint.pipeline
from sceneprint.geometry.kernel import Kernel
marks = {f"{one.__module__}.{one.__qualname__}": one.stamp
         for one in gc.get_objects() if isinstance(one, Kernel)}
print(len(marks), sorted(marks.items()))
"""


def test_the_marks_are_the_same_in_every_process() -> None:
    """Or each would compile for itself: no address and no order may be in them.

    Neither that of a set nor that in which kernels are first used.
    """
    said = [
        subprocess.run(
            [sys.executable, "-c", MARKS.replace("gc.get_objects()", order)],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True, text=True, check=True,
        ).stdout
        for seed, order in (("1", "gc.get_objects()"), ("2", "gc.get_objects()[::-1]"))
    ]  # fmt: skip
    assert int(said[0].split()[0]) > 80
    assert said[0] == said[1]
