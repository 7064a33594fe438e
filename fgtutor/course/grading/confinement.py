"""Confine a submission's process: it may compute and read Python's own files, and nothing else.

Reads limits; changes the calling process for good and gives the names of the protections in force.
Four layers: resource limits (POSIX), a Landlock domain in which the kernel opens nothing but
Python's own files (Linux 5.13), a seccomp filter by which it refuses every system call that
computing does not need (Linux), and an audit hook that refuses the same by name (everywhere, but a
determined attacker can get around a hook in his own process). Sources: landlock(7), seccomp(2),
setrlimit(2), PR_SET_PDEATHSIG(2const), PEP 578.
"""

import ctypes
import math
import os
import platform
import signal
import struct
import sys
import sysconfig
import time
from collections.abc import Collection, Iterator
from contextlib import suppress
from glob import escape, glob
from importlib.abc import MetaPathFinder
from pathlib import Path

NO_NEW_PROCESS, FILES_UNREAD = "no new process", "other files unread"
WALLS = frozenset({NO_NEW_PROCESS, FILES_UNREAD})
"""The protections that only a kernel gives and Python cannot get around: seccomp and Landlock."""

WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
"""Flags of `open` that could change a file."""

# Names and numbers on x86-64 and arm64, from the kernel's tables: arch/x86/entry/syscalls/
# syscall_64.tbl and include/uapi/asm-generic/unistd.h. No fork, exec, socket, kill or ptrace, and
# nothing that changes a file; fcntl and ioctl neither, which could aim a signal at the grader.
_ALLOWED = """
read 0 63, write 1 64, close 3 57, stat 4 -, fstat 5 80, lstat 6 -, lseek 8 62, pread64 17 67,
readv 19 65, writev 20 66, poll 7 -, ppoll 271 73, select 23 -, pselect6 270 72, dup 32 23,
dup2 33 -, dup3 292 24, access 21 -, faccessat 269 48, faccessat2 439 439, getcwd 79 17,
readlink 89 -, readlinkat 267 78, getdents64 217 61, newfstatat 262 79, statx 332 291,
mmap 9 222, mprotect 10 226, munmap 11 215, brk 12 214, mremap 25 216, madvise 28 233,
rt_sigaction 13 134, rt_sigprocmask 14 135, rt_sigreturn 15 139, sigaltstack 131 132,
sched_yield 24 124, sched_getaffinity 204 123, futex 202 98, set_robust_list 273 99,
set_tid_address 218 96, rseq 334 293, membarrier 324 283, restart_syscall 219 128,
nanosleep 35 101, clock_nanosleep 230 115, clock_gettime 228 113, clock_getres 229 114,
gettimeofday 96 169, times 100 153, getitimer 36 102, setitimer 38 103, getpid 39 172,
gettid 186 178, getppid 110 173, getuid 102 174, getgid 104 176, geteuid 107 175, getegid 108 177,
uname 63 160, getrusage 98 165, sysinfo 99 179, arch_prctl 158 -, getrandom 318 278, exit 60 93,
exit_group 231 94
"""
_MACHINES = ("x86_64", "aarch64")
_OPEN = {"x86_64": ((2, 1), (257, 2)), "aarch64": ((56, 2),)}
"""open and openat: their number, and which argument holds the flags."""
_ARCH = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
_LOAD, _EQUAL, _ANY_BIT, _RETURN = 0x20, 0x15, 0x45, 0x06
_ALLOW, _REFUSE, _KILL = 0x7FFF0000, 0x00050001, 0x80000000  # refuse with EPERM
_PR_SET_PDEATHSIG, _PR_SET_NO_NEW_PRIVS, _PR_SET_SECCOMP, _SECCOMP_MODE_FILTER = 1, 38, 22, 2

# include/uapi/linux/landlock.h. The three system calls have the same numbers on every machine.
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446
_RULESET_VERSION, _RULE_PATH_BENEATH = 1, 1
_READ_FILE, _READ_DIR = 1 << 2, 1 << 3
_FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 4: 15, 5: 16}
"""How many rights over files each version of Landlock knows; later ones know as many as the 5th."""

_REFUSED = frozenset(
    (
        "os.fork",
        "os.forkpty",
        "os.exec",
        "os.posix_spawn",
        "os.system",
        "os.kill",
        "os.killpg",
        "os.remove",
        "os.rename",
        "os.truncate",
        "os.mkdir",
        "os.rmdir",
        "os.chmod",
        "os.chown",
        "os.link",
        "os.symlink",
        "os.putenv",
        "subprocess.Popen",
        "pty.spawn",
        "shutil.rmtree",
        "socket.__new__",
        "ctypes.dlopen",
    )
)
"""Audit events that are refused."""


def confine(*, grader: int, memory_mb: int, cpu_seconds: float) -> list[str]:
    """Give up rights for good; return what is in force. Our modules loaded so far stay usable.

    `grader` is the process with which this one ends; `cpu_seconds` is what it may use from now on.
    """
    in_force = _limit(memory_mb, cpu_seconds)
    if sys.platform == "linux":
        if len(os.listdir("/proc/self/task")) > 1:  # the walls would stand around this one alone
            os._exit(1)
        _prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != grader:  # it ended before we asked to be told
            os._exit(1)
        _prctl(_PR_SET_NO_NEW_PRIVS, 1)
    folders, closed = readable()
    if _wall_off_files(folders, closed):
        in_force.append(FILES_UNREAD)
    if _filter_system_calls():
        in_force += [NO_NEW_PROCESS, "no network", "no signal to others", "no file written"]
    _watch(folders, closed)
    sys.meta_path.insert(0, _Offered())
    return in_force


def readable() -> tuple[list[str], list[str]]:
    """Return what computing needs to read, folders and files, and what stays closed inside them.

    That is Python's library, what is installed for it and what those load; our own package, with
    the answers, is closed wherever there is a copy, and so is the clone that it lies in.
    """
    real = os.path.realpath
    prefixes = dict.fromkeys((sys.prefix, sys.base_prefix, sys.exec_prefix, "/usr", "/"))
    libraries = [os.path.join(prefix, lib) for prefix in prefixes for lib in ("lib", "lib64")]
    packages = [p for p in sys.path if os.path.basename(p) in ("site-packages", "dist-packages")]
    paths = sysconfig.get_paths()
    folders = [*libraries, *packages, paths["stdlib"], paths["platstdlib"], "/usr/share/zoneinfo"]
    files = ["/dev/null", "/dev/urandom", "/dev/random", "/etc/ld.so.cache", "/etc/localtime"]
    found = {real(path) for path in (*folders, *files) if os.path.exists(path)}
    # pip leaves "~gtutor" behind when it is interrupted.
    inside = ("*gtutor*", "python*/*-packages/*gtutor*")
    copies = [os.path.join(escape(folder), name) for folder in found for name in inside]
    package = str(Path(real(__file__)).parents[2])
    closed = {package, os.path.dirname(package), *(c for name in copies for c in glob(name))}
    return sorted(found), sorted(closed - found)


def _limit(memory_mb: int, cpu_seconds: float) -> list[str]:
    try:
        import resource
    except ImportError:  # Windows
        return []
    wanted = {
        "CPU time": (resource.RLIMIT_CPU, math.ceil(cpu_seconds + time.process_time())),
        "memory": (resource.RLIMIT_AS, memory_mb * 2**20),
        "file size": (resource.RLIMIT_FSIZE, 0),
        "open files": (resource.RLIMIT_NOFILE, 64),
        # Not in force for root, who is stopped by the seccomp filter alone.
        "processes": (resource.RLIMIT_NPROC, 0),
        "core dump": (resource.RLIMIT_CORE, 0),
    }
    in_force = []
    for name, (limit, value) in wanted.items():
        with suppress(ValueError, OSError):  # a system without this limit, such as memory on macOS
            resource.setrlimit(limit, (value, value))
            in_force.append(f"{name} limited")
    return in_force


def landlock_version() -> int:
    """Return which version of Landlock the kernel has, 0 for none."""
    return max(0, _syscall(_CREATE_RULESET, 0, 0, _RULESET_VERSION))


def _syscall(number: int, *values: int | bytes) -> int:
    if sys.platform != "linux":
        return -1
    syscall = ctypes.CDLL(None, use_errno=True).syscall
    syscall.restype = ctypes.c_long
    # Integers as whole registers: ctypes would pass 32 bits.
    return syscall(number, *(ctypes.c_long(v) if isinstance(v, int) else v for v in values))


def _wall_off_files(folders: Collection[str], closed: Collection[str]) -> bool:
    """Let the kernel open nothing but `folders`, for reading; return whether it can (Landlock)."""
    version = landlock_version()
    if not version:
        return False
    # struct landlock_ruleset_attr {u64 handled_access_fs, handled_access_net, scoped;}, of which
    # older kernels know the beginning: TCP from version 4, signals and sockets from version 6.
    rights = (1 << _FILE_RIGHTS[min(version, 5)]) - 1
    ruleset = struct.pack("QQQ", rights, 3, 3)[: 24 if version >= 6 else 16 if version >= 4 else 8]
    handle = _syscall(_CREATE_RULESET, ruleset, len(ruleset), 0)
    for folder in folders:
        for path, access in _rules(folder, closed):
            try:
                place = os.open(path, os.O_PATH | os.O_CLOEXEC)
            except OSError:  # gone, or not for this user to read in any case
                continue
            # struct landlock_path_beneath_attr {u64 allowed_access; s32 parent_fd;}, packed
            rule = struct.pack("=Qi", access, place)
            failed = _syscall(_ADD_RULE, handle, _RULE_PATH_BENEATH, rule, 0)
            os.close(place)
            if failed:
                raise OSError(ctypes.get_errno(), "Landlock takes no rule for", path)
    confined = _syscall(_RESTRICT_SELF, handle, 0) == 0
    os.close(handle)
    return confined


def _rules(path: str, closed: Collection[str]) -> Iterator[tuple[str, int]]:
    """Yield what may be read under a path: all of it, or everything beside what is closed.

    A rule holds for all that lies below, so the way to a closed folder is opened bit by bit.
    """
    inside = [place for place in closed if place.startswith(path + os.sep)]
    if not os.path.isdir(path):
        yield path, _READ_FILE
    elif not inside:
        yield path, _READ_FILE | _READ_DIR
    else:
        yield path, _READ_DIR
        for entry in os.scandir(path):
            # Where a link leads to is read, if it may be, by its own path.
            if entry.path not in inside and not entry.is_symlink():
                yield from _rules(entry.path, inside)


def filters_system_calls() -> bool:
    """Return whether there is a seccomp filter for this system."""
    return sys.platform == "linux" and platform.machine() in _ARCH


def _filter_system_calls() -> bool:
    """Install the seccomp filter; return whether the kernel took it."""
    if not filters_system_calls():
        return False
    program = _program(platform.machine())
    buffer = ctypes.create_string_buffer(program)
    # struct sock_fprog {unsigned short len; struct sock_filter *filter;}
    header = struct.pack("HL", len(program) // 8, ctypes.addressof(buffer))
    return _prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, header)


def _prctl(option: int, value: int, data: bytes | None = None) -> bool:
    prctl = ctypes.CDLL(None, use_errno=True).prctl
    prctl.argtypes = (ctypes.c_int, ctypes.c_ulong, ctypes.c_char_p, ctypes.c_ulong, ctypes.c_ulong)
    return prctl(option, value, data, 0, 0) == 0


def _program(machine: str) -> bytes:
    """Assemble the filter; an instruction is (code, jump if true, jump if false, operand).

    It reads struct seccomp_data: the number at 0, the architecture at 4, arguments from 16, 8 bytes
    each, of which both machines keep the low half first.
    """
    code = [(_LOAD, 0, 0, 4), (_EQUAL, 1, 0, _ARCH[machine]), (_RETURN, 0, 0, _KILL)]
    code.append((_LOAD, 0, 0, 0))
    column = 1 + _MACHINES.index(machine)
    numbers = [entry.split()[column] for entry in _ALLOWED.split(",")]
    for number in (int(number) for number in numbers if number != "-"):
        code += [(_EQUAL, 0, 1, number), (_RETURN, 0, 0, _ALLOW)]
    for number, argument in _OPEN[machine]:
        code += [
            (_EQUAL, 0, 4, number),
            (_LOAD, 0, 0, 16 + 8 * argument),
            (_ANY_BIT, 0, 1, WRITING),
            (_RETURN, 0, 0, _REFUSE),
            (_RETURN, 0, 0, _ALLOW),
        ]
    code.append((_RETURN, 0, 0, _REFUSE))
    return b"".join(struct.pack("HBBI", *instruction) for instruction in code)


def _watch(folders: Collection[str], closed: Collection[str]) -> None:
    """Refuse by name: changing anything, reading beyond Python's own files, and our own answers."""
    real = os.path.realpath
    opened, shut = (tuple(f.rstrip(os.sep) + os.sep for f in part) for part in (folders, closed))

    def may_read(path: object) -> bool:
        if not isinstance(path, str | bytes):
            return isinstance(path, int) or path is None
        place = real(os.fsdecode(path)) + os.sep
        nearest = [
            max((len(folder) for folder in part if place.startswith(folder)), default=0)
            for part in (opened, shut)
        ]
        return nearest[0] > nearest[1]

    def hook(event: str, arguments: tuple) -> None:
        if event in _REFUSED:
            raise PermissionError(f"the grader does not allow {event}")
        if event == "open":
            path, mode, flags = arguments
            writes = (flags or 0) & WRITING if mode is None else set(str(mode)) & set("wax+")
            if writes or not may_read(path):
                raise PermissionError(f"the grader does not allow opening {path!r:.200}")
        elif event in ("os.listdir", "os.scandir") and not may_read(arguments[0] or "."):
            raise PermissionError(f"the grader does not allow listing {arguments[0]!r:.200}")

    sys.addaudithook(hook)


class _Offered(MetaPathFinder):
    """Finds no module of ours but those already loaded: the answers are among the others."""

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> None:
        """Refuse our own modules, leave all others to the next finder."""
        if fullname.partition(".")[0] == "fgtutor":
            raise ImportError(f"the grader offers no {fullname}: write that part yourself")
