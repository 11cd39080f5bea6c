"""Description of the machine, and resource use of processes from /proc."""

from __future__ import annotations

import os
import platform
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path


def version_of(package: str) -> str:
    """Return the version of a package, or "absent"."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "absent"


def measured_on(command: str) -> str:
    """Return a sentence with the time, machine and command of a measurement."""
    names = [
        line.partition(":")[2].strip()
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if line.startswith("model name")
    ]
    processor = names[0] if names else platform.machine()
    return (
        f"Measured {datetime.now(UTC):%Y-%m-%d} on {processor}, {os.cpu_count()} processors; "
        f"{command}."
    )


def memory_gib() -> float:
    """Return the memory of the machine, GiB."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / (1 << 30)


def seconds_to_import(runs: int = 5) -> float:
    """Return the median wall time of `import sceneprint` beyond the start of Python, seconds."""

    def start(code: str) -> float:
        begin = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], check=True)
        return time.perf_counter() - begin

    return statistics.median(start("import sceneprint") - start("pass") for _ in range(runs))


def peak_megabytes_of_signing(folder: Path, preset: str) -> float:
    """Return the peak resident memory of a process that signs the frames of a folder, MB."""
    code = (
        "import sys\n"
        "from sceneprint.cli import main\n"
        f"main(['sign', sys.argv[1], '--preset', {preset!r}])\n"
        # ru_maxrss survives exec and would include the parent.
        "status = open('/proc/self/status').read()\n"
        "print(status.split('VmHWM:')[1].split()[0], file=sys.stderr)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(folder)], check=True, capture_output=True, text=True
    )
    return int(done.stderr.split()[-1]) / 1024


def read_process(pid: int, name: str) -> bytes:
    """Return the content of /proc/PID/NAME; empty if the process has ended."""
    with suppress(OSError):
        return Path(f"/proc/{pid}/{name}").read_bytes()
    return b""


def running_processes() -> Iterator[tuple[int, int, int]]:
    """Yield process id, process group and parent id of each running process."""
    for path in Path("/proc").glob("[0-9]*"):
        fields = read_process(int(path.name), "stat").rpartition(b")")[2].split()
        if fields and fields[0] != b"Z":
            yield int(path.name), int(fields[2]), int(fields[1])


def peak_bytes(pid: int) -> int:
    """Return the peak memory of a process, bytes."""
    peak = re.search(rb"^VmHWM:\s+(\d+) kB", read_process(pid, "status"), re.MULTILINE)
    return 1024 * int(peak[1]) if peak else 0


def own_bytes(process: Path) -> int:
    """Return the private memory of a process, given its folder under /proc, bytes."""
    lines = (process / "smaps_rollup").read_text().splitlines()
    return sum(1024 * int(line.split()[1]) for line in lines if line.startswith("Private_"))


def processor_ns(process: Path) -> int:
    """Return the processor time of a process (folder under /proc) and its children, ns."""
    total = 0
    for task in process.glob("task/*"):
        total += int((task / "schedstat").read_text().split()[0])
        for child in (task / "children").read_text().split():
            with suppress(OSError):  # the child has ended
                total += processor_ns(Path("/proc") / child)
    return total


def sum_over_processes(figure: Callable[[Path], int], data: Path, command: str) -> int:
    """Return the sum of `figure` over all processes that run a command on a data folder."""
    total = 0
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):  # the process has ended
            words = path.read_bytes().split(b"\0")
            if str(data).encode() in words and command.encode() in words:
                total += figure(path.parent)
    return total
