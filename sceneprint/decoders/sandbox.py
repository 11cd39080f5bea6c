"""Confinement of a process that reads untrusted bytes: no new files, network, processes or memory.

Resource limits (setrlimit) always apply; a kernel or container may lack the system call filter
(seccomp). Open files remain open. Import all code before confinement.
"""

from __future__ import annotations

import ctypes
import os
import platform
import resource
import signal
import struct

from sceneprint.process import limit_memory

_LIBC = ctypes.CDLL(None, use_errno=True)
_PR_SET_PDEATHSIG, _PR_SET_NO_NEW_PRIVS = 1, 38


def die_with_parent(parent: int) -> bool:
    """Let the kernel kill this process when the thread that started it ends.

    Return False if the process `parent` has already ended.
    """
    _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    return os.getppid() == parent


def close_process(more_bytes: int) -> bool:
    """Confine this process irrevocably to computation and open files.

    Return whether seccomp is active; without it, only memory, files and processes are limited.

    Parameters
    ----------
    more_bytes : maximum memory that this process may still allocate, bytes; 0 for no limit
    """
    limit_memory(more_bytes)
    for limit in (resource.RLIMIT_CORE, resource.RLIMIT_FSIZE, resource.RLIMIT_NOFILE,
                  resource.RLIMIT_NPROC):  # fmt: skip
        resource.setrlimit(limit, (0, 0))
    no_new_privileges = _LIBC.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) == 0  # seccomp requires it
    return no_new_privileges and _filter_system_calls()


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
