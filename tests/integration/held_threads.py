"""Threads of a process that are held while its other threads run."""

import contextlib
import ctypes
import os
import pathlib

import pytest

# From <linux/ptrace.h>.
PTRACE_DETACH = 17
PTRACE_SEIZE = 0x4206
PTRACE_INTERRUPT = 0x4207


def threads(pid, name):
    return [int(task.name) for task in pathlib.Path(f"/proc/{pid}/task").iterdir()
            if (task / "comm").read_text().strip() == name]


@contextlib.contextmanager
def held(thread_ids):
    """Threads that run no further meanwhile, while others of their process do."""
    libc = ctypes.CDLL(None, use_errno=True)
    libc.ptrace.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p,
                            ctypes.c_void_p]

    def ptrace(request, thread):
        if libc.ptrace(request, thread, None, None) != 0:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))

    try:
        for thread in thread_ids:
            ptrace(PTRACE_SEIZE, thread)
    except PermissionError:
        pytest.skip("processes may not be traced here")
    for thread in thread_ids:
        ptrace(PTRACE_INTERRUPT, thread)
        os.waitpid(thread, 0x40000000)  # __WALL
    try:
        yield
    finally:
        for thread in thread_ids:
            ptrace(PTRACE_DETACH, thread)
