"""The machine a figure was measured on, and what a process costs there."""

from __future__ import annotations

import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path


@dataclass(frozen=True)
class Machine:
    """What a reader needs to compare figures with their own."""

    processor: str
    cores: int
    memory_gib: float
    python: str
    packages: dict[str, str]


def describe_machine() -> Machine:
    """This machine, as its kernel describes it."""
    from importlib.metadata import PackageNotFoundError, version

    packages = {}
    for name in ("numpy", "numba", "open3d"):
        try:
            packages[name] = version(name)
        except PackageNotFoundError:
            packages[name] = "absent"
    model = [
        line.split(":", 1)[1].strip()
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if line.startswith("model name")
    ]
    pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return Machine(
        processor=model[0] if model else platform.machine(),
        cores=os.cpu_count() or 1,
        memory_gib=round(pages / 2**30, 1),
        python=platform.python_version(),
        packages=packages,
    )


def measured_on(command: str) -> str:
    """Return a sentence that says when, where and by which command figures were measured."""
    machine = describe_machine()
    return (
        f"Measured {datetime.now(UTC):%Y-%m-%d} on {machine.processor}, {machine.cores} "
        f"processors; {command}."
    )


def seconds_to_import(runs: int = 5) -> float:
    """Median wall time that `import sceneprint` adds to an interpreter's start."""

    def start(code: str) -> float:
        begin = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], check=True)
        return time.perf_counter() - begin

    return statistics.median(start("import sceneprint") - start("pass") for _ in range(runs))


def peak_megabytes_of_signing(folder: Path, preset: str) -> float:
    """Peak resident memory of a process that signs the frames of a folder, table mapped."""
    code = (
        "import sys\n"
        "from sceneprint.cli import main\n"
        f"main(['sign', sys.argv[1], '--preset', {preset!r}])\n"
        # not ru_maxrss: that survives exec, and would be the peak of whoever started us
        "status = open('/proc/self/status').read()\n"
        "print(status.split('VmHWM:')[1].split()[0], file=sys.stderr)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(folder)], check=True, capture_output=True, text=True
    )
    return int(done.stderr.split()[-1]) / 1024


def pin_to_one_processor() -> int:
    """Let this process, and every thread it starts, run on one processor only."""
    cpu = max(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cpu})
    return cpu


def own_bytes(process: Path) -> int:
    """Memory that a process, by its folder under /proc, shares with no other."""
    lines = (process / "smaps_rollup").read_text().splitlines()
    return sum(1024 * int(line.split()[1]) for line in lines if line.startswith("Private_"))


def memory_of(folder: Path, command: str) -> int:
    """Bytes that the processes of a command on a data folder have for themselves."""
    return sum(_of_processes(folder, command, own_bytes))


def processor_seconds(folder: Path, command: str) -> float:
    """Processor time that the processes of a command on a data folder have used, in seconds.

    That of processes which they have started and which still run counts as well.
    """

    def used(process: Path) -> int:
        total = 0
        for task in process.glob("task/*"):
            total += int((task / "schedstat").read_text().split()[0])
            for child in (task / "children").read_text().split():
                with suppress(OSError):  # it ended meanwhile
                    total += used(Path("/proc") / child)
        return total

    return 1e-9 * sum(_of_processes(folder, command, used))


def _of_processes(folder: Path, command: str, figure: Callable[[Path], int]) -> Iterator[int]:
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):  # it ended meanwhile
            words = path.read_bytes().split(b"\0")
            if str(folder).encode() in words and command.encode() in words:
                yield figure(path.parent)
