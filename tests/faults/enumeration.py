"""Run an operation with a fault at its first call, its second, and so on, and check each store."""

import os
import select
import shutil
import signal
import threading
import time
import traceback
from collections import Counter
from dataclasses import dataclass, field
from functools import partial

from sceneprint.errors import SceneprintError
from tests.faults.injection import Injector
from tests.faults.operations import (
    ACKNOWLEDGED,
    OPERATIONS,
    RESTORED,
    Store,
    contents,
    fill,
    violations,
)
from tests.whole_engine import Engine

#: Seconds for one child, which no load reaches.
PATIENCE_S = 300.0


@dataclass
class Trials:
    """Number of calls at which a fault was tried, and broken invariants."""

    calls: int = 0
    violations: list[str] = field(default_factory=list)


class Child:
    """A forked process that says lines, and ends.

    Its memory holds all imports of its parent, which makes many deaths affordable.
    """

    def __init__(self, work):
        read, write = os.pipe()
        pid = os.fork()
        if pid == 0:
            os.close(read)
            code = 1
            try:
                work(lambda line: _say(write, line))
                code = 0
            except BaseException:
                traceback.print_exc()
                _say(write, f"! {traceback.format_exc().splitlines()[-1]}")
            os._exit(code)
        os.close(write)
        until, data = time.monotonic() + PATIENCE_S, b""
        while select.select([read], [], [], max(until - time.monotonic(), 0.0))[0]:
            block = os.read(read, 1 << 16)
            data += block
            if not block:
                break
        else:
            os.kill(pid, signal.SIGKILL)
            data += b"! the process hangs\n"
        os.close(read)
        self.lines, self.status = data.decode().splitlines(), os.waitpid(pid, 0)[1]


def _prepare(operation, store, _say):
    with Engine(store.settings) as engine:
        operation[0](engine, store)


def _say_contents(store, say):
    for name, (upload, vector) in contents(store).items():
        say(f"{name} {upload.hex()} {vector.hex()}")


def _done(work):
    """Return what a child says that does some work; raise RuntimeError if it fails."""
    child = Child(work)
    if child.status:
        raise RuntimeError(f"a store cannot be prepared: {child.lines}")
    return child.lines


def _say(pipe, line):
    os.write(pipe, f"{line}\n".encode())


class Enumeration:
    """Prepared stores of each operation, copied for every trial."""

    def __init__(self, work, uploads, server=None):
        self._work, self._uploads, self._server = work, uploads, server
        self._count = 0
        # in this process, which compiles and imports what its children need
        (work / "warm").mkdir(parents=True)
        fill(Store(work / "warm", None, uploads))
        if threading.active_count() > 1:
            raise RuntimeError(f"threads outlive the store: {threading.enumerate()}")
        # in children: the client of object stores starts threads, which later forks would lack
        base = self._store("base", None)
        _done(lambda _: fill(base))
        self._before = {
            name: (bytes.fromhex(upload), bytes.fromhex(vector))
            for name, upload, vector in map(str.split, _done(partial(_say_contents, base)))
        }

    def _store(self, name, template):
        folder = self._work / name
        if template is None:
            folder.mkdir(parents=True)
        else:
            shutil.copytree(self._work / template, folder, symlinks=True)
        url = None
        if self._server is not None:
            url = self._server.create(name, template)
            self._server.create(f"{name}{RESTORED}")
        return Store(folder, url, self._uploads)

    def run(self, operation, fault, *, first=1, step=1):
        """Try a fault at calls `first`, `first + step` and so on, to the end of the operation."""
        if not (self._work / operation).exists():
            _done(partial(_prepare, OPERATIONS[operation], self._store(operation, "base")))
        trials, at = Trials(), first
        is_over = False
        while not is_over:
            failed, broken, is_over = self._try(operation, fault, at)
            if not failed:
                break
            trials.calls += 1
            where = f"{operation}, {fault} at call {at} ({failed})"
            trials.violations += [f"{where}: {one}" for one in broken]
            at += step
        return trials

    def _try(self, operation, fault, at):
        """Return the call that failed, or "" if the operation has fewer; what is wrong; and whether
        the operation had ended before the fault.
        """
        self._count += 1
        store = self._store(f"trial-{self._count}", operation)

        def act(say):
            with Engine(store.settings) as engine:
                injector = Injector(store.folder, fault, at)
                injector.arm()
                try:
                    OPERATIONS[operation][1](engine, store, say)
                except (SceneprintError, OSError) as error:
                    say(f"error {type(error).__name__}")
                if not injector.failed:
                    say("last")
                injector.disarm()
                say(f"failed {injector.failed}" if injector.failed else "finished")

        child = Child(act)
        broken = [line[2:] for line in child.lines if line.startswith("! ")]
        if fault == "interrupts":  # Python and the databases repeat interrupted calls (PEP 475)
            broken += [line for line in child.lines if line.startswith("error ")]
        killed = os.WIFSIGNALED(child.status) and os.WTERMSIG(child.status) == signal.SIGKILL
        failed = "killed" if killed else ""
        for line in child.lines:
            if line.startswith("failed "):
                failed = line.removeprefix("failed ")
        if failed or broken:
            failed = failed or "unknown"
            said = [line for line in child.lines if line.split(" ")[0] in ACKNOWLEDGED]

            def check(say):
                for violation in violations(store, operation, said, self._before):
                    say(violation)

            checked = Child(check)
            broken += [line.removeprefix("! ") for line in checked.lines]
        shutil.rmtree(store.folder)
        if self._server is not None:
            for suffix in ("", RESTORED):
                self._server.drop(f"{store.folder.name}{suffix}")
        return failed, broken, "last" in child.lines


def report(trials):
    """Yield the rows of a table: calls tried for each operation, and violations."""
    totals, faults = Counter[str](), list(dict.fromkeys(fault for _, fault in trials))
    yield "| operation | " + " | ".join(faults) + " | violations |"
    yield "|---|" + "--:|" * (len(faults) + 1)
    for operation in dict.fromkeys(name for name, _ in trials):
        own = {fault: trials[operation, fault] for fault in faults}
        totals.update({fault: one.calls for fault, one in own.items()})
        broken = sum(len(one.violations) for one in own.values())
        totals["violations"] += broken
        counts = " | ".join(str(one.calls) for one in own.values())
        yield f"| {operation} | {counts} | {broken} |"
    counts = " | ".join(str(totals[name]) for name in (*faults, "violations"))
    yield f"| all | {counts} |"
