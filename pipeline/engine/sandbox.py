"""What a process gives away before it touches foreign bytes, so that a hostile file can cost no more than itself.

Limits hold everywhere. The rest is asked of the Linux kernel and needs no privilege: seccomp answers "permission
denied" to sockets, new programs and processes, signals and every change of a file; Landlock leaves only named folders
to be read. Where the kernel lacks one of them, the process goes on and says so.
"""

from __future__ import annotations

import ctypes
import errno
import gc
import os
import platform
import resource
import signal
import struct
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from pipeline.engine.stage import Limits

#: What a kernel may be unable to take away: by the filter of system calls, by the rules for folders.
SEALED = ("the network, other programs and changes of files", "other folders")
#: Share of the computer's memory that is never exceeded, whatever the limit.
_MEMORY_SHARE = 0.75
_OPEN_FILES = 256

# prctl(2)
_SET_DEATH_SIGNAL, _SET_DUMPABLE, _SET_SECCOMP, _SET_NO_NEW_PRIVILEGES = 1, 4, 22, 38
_FILTER_MODE = 2

# capabilities(7): reading what root may read is kept, all other powers of root go
_CAPABILITIES = (0x20080522, (1 << 1) | (1 << 2))

# landlock(7); its calls have the same numbers on every processor
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_READ_FILE, _READ_FOLDER = 1 << 2, 1 << 3
#: Version of the interface -> number of file rights it knows.
_FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 4: 15}
#: Where libraries and the facts of the system are.
_SYSTEM = ("/usr", "/lib", "/lib64", "/etc", "/opt", "/nix", "/gnu", "/snap", "/proc", "/sys", "/dev")

# seccomp(2), bpf(4)
_LOAD, _IF_EQUAL, _IF_AT_LEAST, _IF_ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
_ALLOW, _KILL, _REFUSE = 0x7FFF0000, 0x80000000, 0x00050000
_NUMBER, _PROCESSOR, _ARGUMENTS = 0, 4, 16
_OTHER_ABI = 0x40000000
_CLONE_THREAD = 0x00010000
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
#: Name of a processor -> its mark in seccomp, and the place of its numbers in the tables.
_PROCESSORS = {"x86_64": (0xC000003E, 0), "aarch64": (0xC00000B7, 1)}
#: System calls that are refused: numbers on x86_64 and aarch64, None where there is no such call.
_NETWORK = {"socket": (41, 198), "socketpair": (53, 199), "io_uring_setup": (425, 425)}
_PROCESSES = {
    "fork": (57, None),
    "vfork": (58, None),
    "execve": (59, 221),
    "execveat": (322, 281),
    "ptrace": (101, 117),
    "process_vm_readv": (310, 270),
    "process_vm_writev": (311, 271),
    "kill": (62, 129),
    "tkill": (200, 130),
    "tgkill": (234, 131),
    "rt_sigqueueinfo": (129, 138),
    "rt_tgsigqueueinfo": (297, 240),
    "pidfd_send_signal": (424, 424),
    "pidfd_getfd": (438, 438),
    "unshare": (272, 97),
    "setns": (308, 268),
}
_CHANGES = {
    "creat": (85, None),
    "truncate": (76, 45),
    "rename": (82, None),
    "renameat": (264, 38),
    "renameat2": (316, 276),
    "unlink": (87, None),
    "unlinkat": (263, 35),
    "rmdir": (84, None),
    "link": (86, None),
    "linkat": (265, 37),
    "symlink": (88, None),
    "symlinkat": (266, 36),
    "mkdir": (83, None),
    "mkdirat": (258, 34),
    "mknod": (133, None),
    "mknodat": (259, 33),
    "chmod": (90, None),
    "fchmod": (91, 52),
    "fchmodat": (268, 53),
    "fchmodat2": (452, 452),
    "chown": (92, None),
    "fchown": (93, 55),
    "lchown": (94, None),
    "fchownat": (260, 54),
    "utime": (132, None),
    "utimes": (235, None),
    "futimesat": (261, None),
    "utimensat": (280, 88),
    "setxattr": (188, 5),
    "lsetxattr": (189, 6),
    "fsetxattr": (190, 7),
    "removexattr": (197, 14),
    "lremovexattr": (198, 15),
    "fremovexattr": (199, 16),
}
#: Calls that libraries replace by an older one, which can be judged, where they do not exist.
_UNKNOWN = {"clone3": (435, 435), "openat2": (437, 437)}
#: Calls that are refused by the bits of an argument: numbers, which argument, which bits, refused when one is set.
_BY_BITS = (
    ((2, None), 1, _WRITING, True),
    ((257, 56), 2, _WRITING, True),
    ((56, 220), 0, _CLONE_THREAD, False),
)


def usable_bytes(limits: Limits) -> int:
    """The memory that a process with these limits gets on this computer: at most three quarters of what there is."""
    physical = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return min(limits.memory_bytes, int(_MEMORY_SHARE * physical))


def seal(limits: Limits, readable: Sequence[Path], keep: int, parent: int) -> tuple[str, ...]:
    """Give up, for good, all that reading a file does not need; called once in a fresh child process.

    Parameters
    ----------
    limits : Limits
    readable : sequence of Path
        Folders that may be read besides those of the system and of Python.
    keep : int
        The one open descriptor that stays open.
    parent : int
        Process whose end ends this one.

    Returns
    -------
    tuple of str
        Those of SEALED that this system could not take away.
    """
    os.setsid()
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, ())
    _close_all_but(keep)
    _limit(limits)
    library = ctypes.CDLL(None, use_errno=True)
    _drop_capabilities(library)
    _prctl(library, _SET_DUMPABLE, 0)  # no core file, which would hold the patient's data
    _prctl(library, _SET_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != parent:  # it ended before the line above
        signal.raise_signal(signal.SIGKILL)
    unsealed = not _prctl(library, _SET_NO_NEW_PRIVILEGES, 1)
    folders = unsealed or not _restrict_folders(library, [*readable, *_of_the_program(readable)])
    calls = unsealed or not _filter_calls(library)
    return tuple(word for word, is_open in zip(SEALED, (calls, folders), strict=True) if is_open)


def _close_all_but(keep: int) -> None:
    gc.freeze()  # what the parent forgot to close is not closed later, when its number belongs to another file
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(null, descriptor)
    os.closerange(3, keep)
    os.closerange(keep + 1, os.sysconf("SC_OPEN_MAX"))
    sys.stdin, sys.stdout, sys.stderr = (os.fdopen(number, mode) for number, mode in enumerate("rww"))


def _limit(limits: Limits) -> None:
    with suppress(OSError):  # when memory runs out, it is this process that ends
        Path("/proc/self/oom_score_adj").write_text("1000")
    seconds = int(limits.wall_s) + 1
    wanted = {
        resource.RLIMIT_AS: _address_space() + usable_bytes(limits),
        resource.RLIMIT_CPU: seconds,
        resource.RLIMIT_FSIZE: 0,
        resource.RLIMIT_NOFILE: _OPEN_FILES,
        resource.RLIMIT_CORE: 0,
    }
    for kind, value in wanted.items():
        hard = resource.getrlimit(kind)[1]
        most = value if hard == resource.RLIM_INFINITY else min(value, hard)
        resource.setrlimit(kind, (most, most))


def _address_space() -> int:
    with suppress(OSError):
        return int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    return 0


def _prctl(library: ctypes.CDLL, option: int, value: int, pointer: object = None) -> bool:
    words = (ctypes.c_ulong(value), pointer, ctypes.c_ulong(0), ctypes.c_ulong(0))
    return bool(library.prctl(option, *words) == 0)


def _drop_capabilities(library: ctypes.CDLL) -> None:
    version, kept = _CAPABILITIES
    header = struct.pack("=Ii", version, 0)
    current = ctypes.create_string_buffer(24)
    if library.capget(header, current) == 0:
        effective, permitted = struct.unpack("=6I", current.raw)[:2]
        library.capset(header, struct.pack("=6I", effective & kept, permitted & kept, 0, 0, 0, 0))


def _of_the_program(readable: Sequence[Path]) -> Iterator[Path]:
    """Where code and libraries are, as far as that does not lay the neighbours of a readable folder open."""
    libraries = os.environ.get("LD_LIBRARY_PATH", "").split(":")
    places = [*sys.path, f"{sys.base_prefix}/lib", *libraries, *_SYSTEM]
    yield Path(__file__).resolve().parents[1]
    for place in (Path(place).resolve() for place in places if place):
        if place.is_dir() and not any(folder.is_relative_to(place) for folder in readable):
            yield place


def _restrict_folders(library: ctypes.CDLL, readable: Iterable[Path]) -> bool:
    """Only these folders can be read from here on; whether the kernel could do it."""
    version = _landlock(library, _CREATE_RULESET, None, 0, 1)
    if version < 1:
        return False
    rights = (1 << _FILE_RIGHTS.get(version, 16)) - 1
    words = (rights, 0b11 if version >= 4 else 0, 0b11 if version >= 6 else 0)
    size = 24 if version >= 6 else 16 if version >= 4 else 8
    rules = _landlock(library, _CREATE_RULESET, struct.pack("=3Q", *words), size, 0)
    if rules < 0:
        return False
    for folder in readable:
        with suppress(OSError):
            place = os.open(folder, os.O_PATH | os.O_CLOEXEC)
            beneath = struct.pack("=Qi", _READ_FILE | _READ_FOLDER, place)
            _landlock(library, _ADD_RULE, rules, 1, beneath, 0)
            os.close(place)
    done = _landlock(library, _RESTRICT_SELF, rules, 0) == 0
    os.close(rules)
    return done


def _landlock(library: ctypes.CDLL, *words: object) -> int:
    call = library.syscall
    call.restype = ctypes.c_long
    return int(call(*(ctypes.c_long(word) if isinstance(word, int) else word for word in words)))


def _filter_calls(library: ctypes.CDLL) -> bool:
    """System calls beyond reading and computing are refused from here on; whether the kernel could do it."""
    if platform.machine() not in _PROCESSORS or sys.byteorder != "little":
        return False
    steps = [struct.pack("=HBBI", *step) for step in _filter_steps(*_PROCESSORS[platform.machine()])]
    program = ctypes.create_string_buffer(b"".join(steps))
    header = struct.pack("@HP", len(steps), ctypes.addressof(program))
    return _prctl(library, _SET_SECCOMP, _FILTER_MODE, header)


def _filter_steps(mark: int, column: int) -> Iterator[tuple[int, int, int, int]]:
    """The filter, step by step: operation, how many steps to skip if so and if not, value."""
    yield from ((_LOAD, 0, 0, _PROCESSOR), (_IF_EQUAL, 1, 0, mark), (_RETURN, 0, 0, _KILL))
    yield from ((_LOAD, 0, 0, _NUMBER), (_IF_AT_LEAST, 0, 1, _OTHER_ABI), (_RETURN, 0, 0, _KILL))
    refused = [(numbers, errno.EACCES) for group in (_NETWORK, _PROCESSES, _CHANGES) for numbers in group.values()]
    for numbers, answer in (*refused, *((numbers, errno.ENOSYS) for numbers in _UNKNOWN.values())):
        if (number := numbers[column]) is not None:
            yield from ((_IF_EQUAL, 0, 1, number), (_RETURN, 0, 0, _REFUSE | answer))
    for numbers, argument, bits, when_set in _BY_BITS:
        if (number := numbers[column]) is not None:
            yield from ((_IF_EQUAL, 0, 4, number), (_LOAD, 0, 0, _ARGUMENTS + 8 * argument))
            yield _IF_ANY_BIT, int(not when_set), int(when_set), bits
            yield from ((_RETURN, 0, 0, _REFUSE | errno.EACCES), (_RETURN, 0, 0, _ALLOW))
    yield _RETURN, 0, 0, _ALLOW
