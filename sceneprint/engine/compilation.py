"""Ahead-of-time compilation of numba kernels by separate processes.

Compilation would block requests, so other processes compile the kernels and cache their machine
code on disk: one process compiles the kernels of signing, another those of validation. The kernels
for clouds and for rendered views are compiled when the first cloud or surface arrives.

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

#: The last kernel that each part compiles; if its machine code is cached, the part is complete.
_LAST = {"signing": pair_features._count, "validation": icp.refine_in_place, "clouds": plan._add}
#: Parts that a service for depth images needs, and parts that a service for clouds needs.
DEPTH, ALL = ("signing", "validation"), ("signing", "validation", "clouds")
#: Seconds between checks of the compiling processes.
_LOOK_S = 0.05
#: Seconds between reports of progress.
_REPORT_S = 5.0
#: Lock that is held during compilation; other threads wait for it.
_compiling = threading.Lock()


def missing(parts: Sequence[str] = DEPTH) -> tuple[str, ...]:
    """Return the parts whose kernels are not compiled for this processor and version."""
    return tuple(part for part in parts if not code_folder(_LAST[part])[1])


def compile_kernels(
    cache_dir: Path, parts: Sequence[str] = DEPTH, say: Callable[[str], None] | None = None,
    stop: threading.Event | None = None,
) -> None:  # fmt: skip
    """Compile missing parts, each in its own process, and wait for the processes.

    If a process fails, its kernels are compiled on first use. Numba caches the machine code. The
    target is NUMBA_CPU_NAME, if set, otherwise x86-64-v3, since wider vector instructions are
    slower on processors with slow gather instructions (docs/performance.md); processors that lack
    x86-64-v3 are their own target.

    Parameters
    ----------
    cache_dir : folder of pair tables; calling the kernels creates a table there
    say : function that receives progress messages
    stop : event that cancels the compilation
    """
    with _compiling:
        absent = missing(parts)
        if not absent:
            return
        report, started = say or (lambda _: None), time.monotonic()
        report(
            f"first use after installation: compiling kernels for {' and '.join(absent)}; this "
            "takes half a minute on two idle processors"
        )
        environment = dict(os.environ)
        if not environment.get("NUMBA_CPU_NAME") and runs_here():
            environment |= {"NUMBA_CPU_NAME": TARGET, "NUMBA_CPU_FEATURES": TARGET_FEATURES}
        # compile kernels for clouds last, since they reuse kernels of the other parts; each process
        # writes one byte per compiled kernel to the file
        with os.fdopen(os.memfd_create("compiled kernels"), "wb") as compiled:
            for group in ([part for part in absent if part != "clouds"], ["clouds"]):
                commands = {part: (part, str(cache_dir)) for part in group if part in absent}
                if _run(commands, environment, compiled, report, stop):
                    return
        report(f"compilation finished in {time.monotonic() - started:.0f} s")


def _run(
    commands: Mapping[str, Sequence[str]], environment: Mapping[str, str], compiled: IO[bytes],
    report: Callable[[str], None], stop: threading.Event | None,
) -> bool:  # fmt: skip
    """Run commands that compile kernels, and report progress; return whether `stop` ended them."""
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
                report(f"compiled {os.fstat(compiled.fileno()).st_size} kernels so far")
            for part, process in [*running.items()]:
                if process.poll() is not None:
                    del running[part]
                    if process.returncode:
                        report(
                            f"kernels for {part} not compiled (exit code {process.returncode}); "
                            "they are compiled on first use"
                        )
            time.sleep(_LOOK_S)
    finally:
        for process in running.values():
            process.terminate()
            process.wait()
    return False


def _compile(part: str, cache_dir: Path) -> None:
    """Compile the kernels of a part by calling each kernel once."""
    from sceneprint.engine.signers import warm_clouds, warm_signing, warm_validation, warm_views
    from sceneprint.pipeline import open_signer

    model = read_model(PRESETS[0])
    p = model.parameters.validation
    # a stored artifact makes validation independent of signing
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
            """Do nothing; kernels are counted when their compilation ends."""

        def on_end(self, _event: Any) -> None:
            sys.stdout.write(".")
            sys.stdout.flush()

    register("numba:compile", Reporter())


if __name__ == "__main__":
    _report_kernels()
    _compile(sys.argv[1], Path(sys.argv[2]))
