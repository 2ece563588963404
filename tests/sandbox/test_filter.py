"""The filter of system calls, run here as the kernel would run it."""

import errno
import struct

import pytest

from ventbench.sandbox.child import seccomp
from ventbench.sandbox.child.seccomp import ALLOW, AUDIT, KILL

PID = 4321
EPERM, ENOSYS = (seccomp.errno_action(e) for e in (errno.EPERM, errno.ENOSYS))


def kernel(program, number, arguments=(), arch="x86_64"):
    """The action of a program: an interpreter of the few instructions that are used."""
    arguments = [a & (2**64 - 1) for a in (*arguments, *[0] * 6)][:6]
    data = struct.pack("<IIQ6Q", number, AUDIT[arch], 0, *arguments)
    code = list(struct.iter_unpack("<HBBI", program))
    at = accumulator = 0
    while True:
        operation, true, false, k = code[at]
        at += 1
        match operation:
            case 0x20:
                (accumulator,) = struct.unpack_from("<I", data, k)
            case 0x54:
                accumulator &= k
            case 0x15:
                at += true if accumulator == k else false
            case 0x35:
                at += true if accumulator >= k else false
            case 0x06:
                return k
            case _:
                raise AssertionError(f"instruction {operation:#x}")


@pytest.fixture(params=["x86_64", "aarch64"])
def machine(request):
    return request.param


@pytest.fixture
def ask(machine):
    program = seccomp.cell_filter(machine, PID, threads=False)

    def asked(call, *arguments):
        number = getattr(call, machine)
        return kernel(program, number, arguments, machine)

    return asked


def test_plain_calls_are_allowed(ask, machine):
    for call in seccomp.PLAIN.values():
        if getattr(call, machine) is not None:
            assert ask(call, -1, -1, -1, -1, -1, -1) == ALLOW


def test_everything_else_is_refused(machine):
    program = seccomp.cell_filter(machine, PID, threads=False)
    named = (*seccomp.PLAIN.values(), *seccomp.CHECKED.values(), *seccomp.MISSING.values())
    known = {getattr(call, machine) for call in (*named, seccomp.OPEN, seccomp.OPENAT)}
    for number in set(range(1000)) - known:
        assert kernel(program, number, arch=machine) == EPERM


def test_another_machines_calls_end_the_process(machine):
    program = seccomp.cell_filter(machine, PID, threads=False)
    other = "aarch64" if machine == "x86_64" else "x86_64"
    assert kernel(program, 0, arch=other) == KILL
    if machine == "x86_64":
        assert kernel(program, 0x40000000, arch=machine) == KILL


def test_files_open_for_reading_alone(ask):
    reading, cloexec, folder = 0, 0o2000000, 0o200000
    assert ask(seccomp.OPENAT, -100, 0, reading | cloexec | folder) == ALLOW
    for flags in (0o1, 0o2, 0o3, 0o100, 0o1000, 0o20200000, 0o10000000):
        assert ask(seccomp.OPENAT, -100, 0, flags | cloexec) == EPERM


@pytest.mark.parametrize(
    ("name", "good", "bad"),
    [
        ("ioctl", (1, 0x5401), (1, 0x5412)),
        ("fcntl", (3, 1030), (3, 6)),
        ("fcntl", (3, 3), (3, 1024)),
        ("futex", (0, 128 | 1), (0, 1)),
        ("futex", (0, 9 | 256), (0, 10)),
        ("madvise", (0, 0, 4), (0, 0, 21)),
        ("prlimit64", (0, 7, 0, 1), (0, 7, 1, 0)),
        ("prlimit64", (0, 7, 0, 1), (0, 7, 1 << 32, 0)),
        ("prlimit64", (0, 7, 0, 1), (PID, 7, 0, 0)),
        ("tgkill", (PID, 1, 6), (PID + 1, 1, 6)),
    ],
)
def test_arguments_are_looked_at(ask, name, good, bad):
    assert ask(seccomp.CHECKED[name], *good) == ALLOW
    assert ask(seccomp.CHECKED[name], *bad) == EPERM


def test_threads_only_where_they_are_needed(machine):
    thread, process = 0x10000 | 0xF00, 17
    number = getattr(seccomp.CHECKED["clone"], machine)
    with_threads = seccomp.cell_filter(machine, PID, threads=True)
    assert kernel(with_threads, number, (thread,), machine) == ALLOW
    assert kernel(with_threads, number, (process,), machine) == EPERM
    without = seccomp.cell_filter(machine, PID, threads=False)
    assert kernel(without, number, (thread,), machine) == EPERM


def test_calls_that_hide_their_arguments_seem_missing(ask):
    for call in seccomp.MISSING.values():
        assert ask(call) == ENOSYS
