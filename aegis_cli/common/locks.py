"""A folder that only one process at a time writes to.

The lock is a kernel lock on the folder itself: it leaves no file behind, and it is released when
the process that holds it ends, however that happens.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import time
from collections.abc import Generator
from pathlib import Path

from aegis_cli.common import files
from aegis_cli.common.errors import AegisError

# Errors of a file system that cannot lock folders, such as NFS; there a file beside it is locked.
_NO_FOLDER_LOCKS = (errno.EBADF, errno.EINVAL, errno.ENOLCK, errno.ENOTSUP, errno.EISDIR)


@contextlib.contextmanager
def alone(folder: Path) -> Generator[None]:
    """Be the only process that writes to `folder` inside the block.

    The folder is created if it does not exist. If it is empty at the end, as after a refusal, it is
    removed again, with its parents that were created.

    Raises:
        AegisError: another process holds the lock, the folder cannot be created, or its path is not
            text, so that nothing could be read from it afterwards.
    """
    folder = Path(folder)
    files.check_utf8(folder, "choose another --out, or rename the folder")
    made, descriptor, beside = _locked(folder)
    try:
        yield
    finally:
        # Removed while the lock is held. No process waits for it: others are refused at once.
        with contextlib.suppress(OSError):
            if beside is not None:
                beside.unlink()
        for path in made:
            with contextlib.suppress(OSError):  # it is not empty
                path.rmdir()
        os.close(descriptor)


def _locked(folder: Path) -> tuple[list[Path], int, Path | None]:
    """Lock the folder.

    Returns:
        The folders that were created for it, innermost first, the descriptor that holds the lock,
        and the file that is locked instead of the folder; None if it is the folder itself.
    """
    if folder.exists() and not folder.is_dir():
        raise AegisError(f"'{folder}' is no folder", "a new or empty one", "choose another --out")
    above = [folder, *folder.parents]
    made = [path for path in above if not path.exists()]
    # Repeated, because another process may remove the folder between creating, opening and locking
    # it; then the lock is on a folder that has no path any more.
    while True:
        files.make_folder(folder)
        try:
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        except FileNotFoundError:
            continue  # removed meanwhile by a process that was refused
        try:
            beside = _lock(descriptor, folder)
        except BaseException:
            os.close(descriptor)
            raise
        if beside is not None:
            descriptor, lock = beside
            return made, descriptor, lock
        if _is_still(folder, descriptor):
            return made, descriptor, None
        os.close(descriptor)


def _lock(descriptor: int, folder: Path) -> tuple[int, Path] | None:
    """Lock the open folder; if its file system cannot, lock and return a file beside it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise _refusal(descriptor, folder) from None
    except OSError as error:
        if error.errno not in _NO_FOLDER_LOCKS:
            raise
    else:
        return None
    beside = folder.resolve().with_name(f"{files.hidden(folder.resolve())}.lock")
    while True:
        own = os.open(beside, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(own, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            refusal = _refusal(own, folder)
            os.close(own)
            raise refusal from None
        if _is_still(beside, own):
            os.close(descriptor)
            return own, beside
        os.close(own)  # the holder has ended and removed the file: create another one


def _is_still(path: Path, descriptor: int) -> bool:
    """Whether the path still refers to what is open, rather than to a replacement."""
    with contextlib.suppress(OSError):
        return os.path.samestat(os.stat(path), os.fstat(descriptor))
    return False


# --- who holds it ---------------------------------------------------------------------------------


def _refusal(descriptor: int, folder: Path) -> AegisError:
    holder = _holder(os.fstat(descriptor))
    which = "another process" if holder is None else _described(holder)
    return AegisError(
        f"'{folder}' is being written to by {which}",
        "a folder that no other process is writing to",
        "wait until it ends, or choose another --out",
    )


def _holder(locked: os.stat_result) -> int | None:
    """Id of the process that holds the lock, if this machine's kernel knows it."""
    with contextlib.suppress(OSError, ValueError):
        for line in Path("/proc/locks").read_text(encoding="utf-8").splitlines():
            fields = line.split()  # 1: FLOCK ADVISORY WRITE 708 08:01:131105 0 EOF
            if fields[1] == "FLOCK" and int(fields[5].rpartition(":")[2]) == locked.st_ino:
                holder = int(fields[4])
                return holder if holder > 0 else None
    return None


def _described(holder: int) -> str:
    """A process in words: its id, this machine's name, and when it started."""
    where = f"process {holder} on {os.uname().nodename}"
    with contextlib.suppress(OSError, ValueError, StopIteration):
        stat = Path(f"/proc/{holder}/stat").read_text(encoding="utf-8", errors="replace")
        fields = stat.rpartition(")")[2].split()  # after the name, which may contain anything
        boot = Path("/proc/stat").read_text(encoding="utf-8").splitlines()
        booted = int(next(line for line in boot if line.startswith("btime")).split()[1])
        began = booted + int(fields[19]) / os.sysconf("SC_CLK_TCK")
        return f"{where}, since {time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(began))}"
    return where
