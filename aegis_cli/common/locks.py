"""A folder that one process at a time writes to.

The lock is the kernel's, on the folder itself: it leaves no file behind, and it is gone with the
process that held it, however that ended.
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

# What a file system says that locks no folders, such as NFS; there a file beside it is locked.
_NO_FOLDER_LOCKS = (errno.EBADF, errno.EINVAL, errno.ENOLCK, errno.ENOTSUP, errno.EISDIR)


@contextlib.contextmanager
def alone(folder: Path) -> Generator[None]:
    """Be the only process that writes to `folder` inside the block.

    The folder is made if it is not there. If it is empty at the end, as after a refusal, it is
    removed again, with those above it that were made.

    Raises:
        AegisError: another process is at it, the folder cannot be made, or nothing could be read
            from it afterwards, because its path is no text.
    """
    folder = Path(folder)
    files.check_utf8(folder, "choose another --out, or rename the folder")
    made, descriptor, beside = _locked(folder)
    try:
        yield
    finally:
        # Those who wait for nothing need not see a lock's file or an empty folder go.
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
        The folders that were made for it, innermost first, the descriptor that holds the lock, and
        the file that is locked in the folder's place; None where it is the folder itself.
    """
    if folder.exists() and not folder.is_dir():
        raise AegisError(f"'{folder}' is no folder", "a new or empty one", "choose another --out")
    above = [folder, *folder.parents]
    made = [path for path in above if not path.exists()]
    # Again and again, for between the making, the opening and the locking another process may
    # remove the folder; then the lock is on one that no path leads to any more.
    while True:
        files.make_folder(folder)
        try:
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        except FileNotFoundError:
            continue  # it was removed since, by one who was refused
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
    """Lock the open folder; where its file system cannot, a file beside it, which is returned."""
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
        os.close(own)  # its holder has ended and removed the file: another one is made


def _is_still(path: Path, descriptor: int) -> bool:
    """Whether the path leads to what is open, rather than to something made in its place."""
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
    """Number of the process that holds the lock, as far as this machine's kernel tells."""
    with contextlib.suppress(OSError, ValueError):
        for line in Path("/proc/locks").read_text(encoding="utf-8").splitlines():
            fields = line.split()  # 1: FLOCK ADVISORY WRITE 708 08:01:131105 0 EOF
            if fields[1] == "FLOCK" and int(fields[5].rpartition(":")[2]) == locked.st_ino:
                holder = int(fields[4])
                return holder if holder > 0 else None
    return None


def _described(holder: int) -> str:
    """A process in words: its number, this machine's name, and when it began."""
    where = f"process {holder} on {os.uname().nodename}"
    with contextlib.suppress(OSError, ValueError, StopIteration):
        stat = Path(f"/proc/{holder}/stat").read_text(encoding="utf-8", errors="replace")
        fields = stat.rpartition(")")[2].split()  # what follows the name, which may be anything
        boot = Path("/proc/stat").read_text(encoding="utf-8").splitlines()
        booted = int(next(line for line in boot if line.startswith("btime")).split()[1])
        began = booted + int(fields[19]) / os.sysconf("SC_CLK_TCK")
        return f"{where}, since {time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(began))}"
    return where
