"""Compiling kernels before anyone waits for them, in processes of their own beside each other.

A process that compiles answers nobody meanwhile. So kernels are compiled by others, which leave
the machine code on disk: those of signing by one, those of validation by another, as neither
needs the other's. Kernels of clouds, and of views of a whole surface, are compiled when the first
of these comes.

    python -m sceneprint.engine.compilation signing|validation|clouds FOLDER_OF_TABLES
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import IO, Any

from sceneprint.formats.artifact import read_geometry
from sceneprint.geometry.kernel import TARGET, TARGET_FEATURES, code_folder, runs_here
from sceneprint.geometry.registration import icp
from sceneprint.geometry.signature import pair_features
from sceneprint.geometry.views import plan
from sceneprint.models import PRESETS, read_model

#: A kernel of each part that is among the last to be compiled: where it is, so are the others.
_LAST = {"signing": pair_features._count, "validation": icp.refine_in_place, "clouds": plan._add}
#: What a service for depth images needs, and what it needs for clouds as well.
DEPTH, ALL = ("signing", "validation"), ("signing", "validation", "clouds")
#: Seconds between two looks whether they are compiled.
_LOOK_S = 0.05
#: Seconds between two reports of progress.
_REPORT_S = 5.0
#: Those who need kernels wait for whoever compiles them.
_compiling = threading.Lock()


def missing(parts: Sequence[str] = DEPTH) -> tuple[str, ...]:
    """Which of the parts are yet to be compiled for this processor, or for this version."""
    return tuple(part for part in parts if not code_folder(_LAST[part])[1])


def compile_kernels(
    cache_dir: Path, parts: Sequence[str] = DEPTH, say: Callable[[str], None] | None = None,
    stop: threading.Event | None = None,
) -> None:  # fmt: skip
    """Compile parts that are missing, in a process each, and wait for them.

    Where a process fails, kernels are compiled when they are first used. Machine code is for every
    processor from x86-64-v3 on: with the wider registers of its own, one that gathers scattered
    numbers slowly is slower (docs/performance.md). It is for this one where this one is another,
    as arm64 is, or where the environment names one (NUMBA_CPU_NAME).

    Parameters
    ----------
    cache_dir : of pair tables: the one that signing needs is built on the way
    parts : of `ALL`
    say : takes each line of progress
    stop : once it is set, nothing more is compiled
    """
    with _compiling:
        wanted = missing(parts)
        if not wanted:
            return
        tell, begun = say or (lambda _: None), time.monotonic()
        tell(
            f"first use after installation: compiling kernels for {' and '.join(wanted)}, once; "
            "it takes half a minute on two idle processors"
        )
        environment = dict(os.environ)
        if not environment.get("NUMBA_CPU_NAME") and runs_here():
            environment |= {"NUMBA_CPU_NAME": TARGET, "NUMBA_CPU_FEATURES": TARGET_FEATURES}
        # clouds are validated with the kernels of the other parts: compiled twice, if beside them
        # each process writes a byte to it for each kernel
        with os.fdopen(os.memfd_create("compiled kernels"), "wb") as compiled:
            for group in ([one for one in wanted if one != "clouds"], ["clouds"]):
                commands = {part: (part, str(cache_dir)) for part in group if part in wanted}
                if _run(commands, environment, compiled, tell, stop):
                    return
        tell(f"compilation finished in {time.monotonic() - begun:.0f} s")


def _run(
    commands: Mapping[str, Sequence[str]], environment: Mapping[str, str], compiled: IO[bytes],
    tell: Callable[[str], None], stop: threading.Event | None,
) -> bool:  # fmt: skip
    """Compile parts beside each other; return whether `stop` ended it."""
    running: dict[str, subprocess.Popen[bytes]] = {}
    try:
        for part, arguments in commands.items():
            running[part] = subprocess.Popen(
                [sys.executable, "-m", "sceneprint.engine.compilation", *arguments],
                env=environment,
                stdin=subprocess.DEVNULL, stdout=compiled, stderr=subprocess.DEVNULL,
            )  # fmt: skip
        next_report = time.monotonic() + _REPORT_S
        while running:
            if stop is not None and stop.is_set():
                return True
            if time.monotonic() > next_report:
                next_report += _REPORT_S
                tell(f"compiled {os.fstat(compiled.fileno()).st_size} kernels so far")
            for part, process in [*running.items()]:
                if process.poll() is not None:
                    del running[part]
                    if process.returncode:
                        tell(
                            f"compiling kernels for {part} failed (exit code {process.returncode})"
                            ": they are compiled on first use"
                        )
            time.sleep(_LOOK_S)
    finally:
        for process in running.values():
            process.terminate()
            process.wait()
    return False


def _compile(part: str, cache_dir: Path) -> None:
    """Use every kernel of a part once."""
    from sceneprint.engine.signers import warm_clouds, warm_signing, warm_validation, warm_views
    from sceneprint.pipeline import open_signer

    model = read_model(PRESETS[0])
    p = model.parameters.validation
    # the corner as signing left it, so that validation need not wait for that
    corner = read_geometry(files("sceneprint.engine").joinpath("corner.artifact").read_bytes())
    if part == "validation":
        warm_validation(corner, p)
        return
    signer = open_signer(model, cache_dir)
    if part == "signing":
        warm_signing(signer)
    else:
        warm_clouds(signer, corner)
        warm_views()


def _report_kernels() -> None:
    """Write a byte to standard output whenever a kernel is compiled."""
    from numba.core import event

    register: Any = event.register  # numba has no types

    class Reporter(event.Listener):
        def on_start(self, _event: Any) -> None:
            """Do nothing: kernels are counted at their end."""

        def on_end(self, _event: Any) -> None:
            sys.stdout.write(".")
            sys.stdout.flush()

    register("numba:compile", Reporter())


if __name__ == "__main__":
    _report_kernels()
    _compile(sys.argv[1], Path(sys.argv[2]))
