"""Atomic file writing: a reader sees the old file or the new one, never half of it."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


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
    except OSError as error:
        raise OSError(
            error.errno,
            f"cannot write {str(target)!r} ({error.strerror or error}): check the folder's permissions and the free "
            "space of its disk, or choose another output folder",
        ) from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
