"""Confinement of a process that reads untrusted bytes: no new files, network, processes or memory.

close_process  -->  Protections: the protections that this kernel supports

The protections are independent, and a kernel or container may lack some of them: resource limits
(setrlimit), no new privileges, a system call filter (seccomp), and rules for files, TCP and signals
(Landlock). Open files remain open. Import all code before confinement.
"""

from __future__ import annotations

import ctypes
import os
import platform
import resource
import signal
import struct
from dataclasses import dataclass

from sceneprint.process import limit_memory

_LIBC = ctypes.CDLL(None, use_errno=True)
_PR_SET_PDEATHSIG, _PR_SET_NO_NEW_PRIVS = 1, 38


@dataclass(frozen=True)
class Protections:
    """The protections of a process, in addition to limits on memory, files and processes.

    Parameters
    ----------
    no_new_privileges : whether programs that the process executes cannot gain privileges
    seccomp : whether only system calls for memory, time and open files are allowed
    landlock : version of Landlock that forbids files, TCP and signals; 0 if unavailable
    """

    no_new_privileges: bool
    seccomp: bool
    landlock: int

    @property
    def text(self) -> str:
        """Return a list of the protections for logs and pages."""
        protections = ["limits on memory and time"]
        protections += ["no new privileges"] if self.no_new_privileges else []
        protections += ["seccomp"] if self.seccomp else []
        protections += [f"Landlock {self.landlock}"] if self.landlock else []
        return ", ".join(protections)


def die_with_parent(parent: int) -> bool:
    """Let the kernel kill this process when the thread that started it ends.

    Return False if the process `parent` has already ended.
    """
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    return os.getppid() == parent


def close_process(more_bytes: int) -> Protections:
    """Confine this process irrevocably to computation and open files; return its protections.

    `more_bytes`: maximum memory that this process may still allocate, bytes; 0 for no limit.
    """
    limit_memory(more_bytes)
    no_new = _LIBC.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0
    # Landlock and seccomp require no_new_privs; seccomp is last, since it forbids the other calls
    landlock = _restrict_by_landlock() if no_new else 0
    for limit in (resource.RLIMIT_CORE, resource.RLIMIT_FSIZE, resource.RLIMIT_NOFILE,
                  resource.RLIMIT_NPROC):  # fmt: skip
        resource.setrlimit(limit, (0, 0))
    return Protections(no_new, no_new and _filter_system_calls(), landlock)


# Landlock: a ruleset without rules forbids all access that it handles.

_CREATE_RULESET, _RESTRICT_SELF = 444, 446  #: system call numbers, the same on all processors
_GET_VERSION = 1
#: Number of file access rights by Landlock version.
_FILE_BITS = {1: 13, 2: 14, 3: 15, 4: 15, 5: 16}


def _restrict_by_landlock() -> int:
    """Forbid all access that Landlock handles; return its version, or 0 if unavailable."""
    version = int(_LIBC.syscall(_CREATE_RULESET, None, 0, _GET_VERSION))
    if version < 1:
        return 0
    files = (1 << _FILE_BITS[min(version, max(_FILE_BITS))]) - 1
    network = 3 if version >= 4 else 0  # binding and connecting TCP sockets
    scoped = 3 if version >= 6 else 0  # connecting to abstract sockets, signalling other processes
    rules = struct.pack("=QQQ", files, network, scoped)
    size = 24 if version >= 6 else 16 if version >= 4 else 8
    ruleset = int(_LIBC.syscall(_CREATE_RULESET, rules, size, 0))
    if ruleset < 0:
        return 0
    closed = _LIBC.syscall(_RESTRICT_SELF, ruleset, 0) == 0
    os.close(ruleset)
    return version if closed else 0


# seccomp: a classic BPF program checks the number, architecture and arguments of a system call.

_SECCOMP = {"x86_64": 317, "aarch64": 277}
_ARCHITECTURE = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
#: Numbers of the allowed system calls: access to open files, memory, time, and exit.
_ALLOWED = {
    "x86_64": {
        "read": 0, "write": 1, "close": 3, "fstat": 5, "munmap": 11, "brk": 12,
        "rt_sigaction": 13, "rt_sigprocmask": 14, "rt_sigreturn": 15, "sched_yield": 24,
        "mremap": 25, "madvise": 28, "nanosleep": 35, "getpid": 39, "exit": 60,
        "gettimeofday": 96, "sigaltstack": 131, "gettid": 186, "futex": 202,
        "restart_syscall": 219, "clock_gettime": 228, "clock_nanosleep": 230,
        "exit_group": 231, "getrandom": 318, "rseq": 334,
    },
    "aarch64": {
        "read": 63, "write": 64, "close": 57, "fstat": 80, "munmap": 215, "brk": 214,
        "rt_sigaction": 134, "rt_sigprocmask": 135, "rt_sigreturn": 139, "sched_yield": 124,
        "mremap": 216, "madvise": 233, "nanosleep": 101, "getpid": 172, "exit": 93,
        "gettimeofday": 169, "sigaltstack": 132, "gettid": 178, "futex": 98,
        "restart_syscall": 128, "clock_gettime": 113, "clock_nanosleep": 115,
        "exit_group": 94, "getrandom": 278, "rseq": 293,
    },
}  # fmt: skip
#: Numbers of mmap and mprotect, which are allowed only for memory that is not executable.
_MAPPING = {"x86_64": (9, 10), "aarch64": (222, 226)}
_PROT_EXEC = 4
_FIRST_X32 = 0x40000000  #: smallest number of an x32 system call on x86-64
_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
_NUMBER, _ARCH, _THIRD_ARGUMENT = 0, 4, 32
_ALLOW, _DENY, _KILL = 0x7FFF0000, 0x00050000 | 1, 0x80000000  #: a refused call fails with EPERM
_SET_FILTER, _ALL_THREADS = 1, 1


def filter_program(machine: str) -> list[tuple[int, int, int, int]]:
    """Return the system call filter as BPF instructions: code, jumps if true and false, operand.

    `machine`: result of `platform.machine()`, x86_64 or aarch64.
    """
    allowed, mapping = sorted(_ALLOWED[machine].values()), _MAPPING[machine]
    program = [
        (_LOAD, 0, 0, _ARCH),
        (_EQUAL, 1, 0, _ARCHITECTURE[machine]),
        (_RETURN, 0, 0, _KILL),
        (_LOAD, 0, 0, _NUMBER),
        (_AT_LEAST, 0, 1, _FIRST_X32),
        (_RETURN, 0, 0, _KILL),
    ]
    rest = len(allowed)
    # jumps lead to the instructions after the comparisons: refuse, allow, check memory protection
    program += [(_EQUAL, rest + 1 - i + 2, 0, number) for i, number in enumerate(mapping)]
    program += [(_EQUAL, rest - i, 0, number) for i, number in enumerate(allowed)]
    program += [
        (_RETURN, 0, 0, _DENY),
        (_RETURN, 0, 0, _ALLOW),
        (_LOAD, 0, 0, _THIRD_ARGUMENT),
        (_ANY_BIT, 0, 1, _PROT_EXEC),
        (_RETURN, 0, 0, _DENY),
        (_RETURN, 0, 0, _ALLOW),
    ]
    return program


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("instructions", ctypes.c_char_p))


def _filter_system_calls() -> bool:
    machine = platform.machine()
    if machine not in _ALLOWED or struct.calcsize("P") != 8:
        return False
    code = b"".join(struct.pack("=HBBI", *instruction) for instruction in filter_program(machine))
    program = _Program(len(code) // 8, code)
    return bool(
        _LIBC.syscall(_SECCOMP[machine], _SET_FILTER, _ALL_THREADS, ctypes.byref(program)) == 0
    )
