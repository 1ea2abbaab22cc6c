"""Atomic file writing: a reader sees the old file or the new one, never half of it."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

#: What is in the errors of libraries that write by themselves, as torch and safetensors: they are no OSError.
_TEXTS = {
    os.strerror(code).lower(): code for code in (errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EDQUOT, errno.EFBIG)
}
_TEXTS |= {"iostream error": errno.EIO, "inline_container.cc": errno.EIO}  # torch.save keeps the reason to itself


def _disk_code(error: BaseException) -> int | None:
    """The number of the system's error that a library's error reports; None if it is of another kind."""
    if isinstance(error, OSError):
        return error.errno or errno.EIO
    text = str(error).lower()
    found = [code for phrase, code in _TEXTS.items() if phrase in text]
    return found[0] if found else None


@contextmanager
def disk_errors(path: str | os.PathLike[str]) -> Iterator[None]:
    """Makes each error of the disk inside the block one that names the file and the way out.

    Args:
        path: the file or folder that is written.

    Raises:
        OSError: for an ``OSError``, and for the error of a library that reports a full or read-only disk otherwise.

    Examples:
        >>> with disk_errors("/runs/bc"):
        ...     raise RuntimeError("unable to write to file: No space left on device (28)")
        Traceback (most recent call last):
        ...
        OSError: [Errno 28] cannot write '/runs/bc' (No space left on device): check the folder's permissions and the
        free space of its disk, or choose another output folder
    """
    try:
        yield
    except Exception as error:
        code = _disk_code(error)
        if code is None or "cannot write" in str(error):
            raise
        reason = getattr(error, "strerror", None) or (str(error) if isinstance(error, OSError) else os.strerror(code))
        raise OSError(
            code,
            f"cannot write {str(path)!r} ({reason}): check the folder's permissions and the free space of its disk, "
            "or choose another output folder",
        ) from error


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yields a temporary path beside ``path`` and moves it there once the block has succeeded.

    Args:
        path: the file to write. Its folder is created if needed.

    Yields:
        The temporary path to write to, with the same suffix.

    Raises:
        OSError: if the folder or file cannot be written; the message names the file and what to check. An
            existing file at ``path`` is left as it was.

    Examples:
        >>> import tempfile, pathlib
        >>> target = pathlib.Path(tempfile.mkdtemp()) / "rows.csv"
        >>> with atomic_path(target) as temporary:
        ...     _ = temporary.write_text("a,b")
        >>> target.read_text()
        'a,b'
    """
    target = Path(path)
    temporary: Path | None = None
    try:
        with disk_errors(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(prefix=f".{target.stem}-", suffix=target.suffix, dir=target.parent)
            os.close(handle)
            temporary = Path(name)
            yield temporary
            umask = os.umask(0)
            os.umask(umask)
            temporary.chmod(0o666 & ~umask)  # mkstemp's files are the user's alone, an ordinary file is not
            os.replace(temporary, target)
            temporary = None
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def check_writable(folder: str | os.PathLike[str]) -> None:
    """Makes a folder, and fails at once where nothing can be written to it.

    Args:
        folder: of files that are written later.

    Raises:
        OSError: if it cannot be written; the message names it and what to check.
    """
    mark = Path(folder) / ".writable"
    with disk_errors(folder):
        mark.parent.mkdir(parents=True, exist_ok=True)
        mark.write_text("x")
        mark.unlink()
