"""Where the built kernels are, whether they fit, and whether they are used."""

from __future__ import annotations

import ctypes
import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes import c_float, c_int, c_int64, c_void_p
from pathlib import Path

import torch
from torchrl._utils import logger

#: Of the C interface, ``tsallis_version()``; a library of another one is not used.
VERSION = 1
SOURCES = Path(__file__).parent / "src"
LEVELS = ("none", "AVX2", "AVX-512")

_library: ctypes.CDLL | None = None
_looked = False  # for the library, in this process
_used = os.environ.get("TSALLIS_NATIVE", "") != "0"


def built_path() -> Path:
    """Where ``build`` puts the library: the name changes with the sources, so that an old one is never found.

    Examples:
        >>> built_path().suffix
        '.so'
    """
    digest = hashlib.sha256()
    for path in sorted(SOURCES.iterdir()):
        digest.update(path.read_bytes())
    own = os.environ.get("TSALLIS_NATIVE_DIR")
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchrl_tsallis"
    return Path(own or cache) / f"kernels-{digest.hexdigest()[:16]}.so"


def library_paths() -> list[Path]:
    """Where the library is looked for: in the package, as a wheel brings it, then where ``build`` puts it."""
    return [*sorted(Path(__file__).parent.glob("_kernels*.so")), built_path()]


def _declare(library: ctypes.CDLL) -> None:
    """Says the types of the C interface, so that a wrong call is an error in Python."""
    pointer, size, real = c_void_p, c_int64, c_float
    network = [size, size, size, pointer, pointer, pointer, pointer]  # members, rows, linears, sizes, x, params, eps
    segments = [size, pointer, pointer]
    for name, arguments in {
        "tsallis_use_level": [c_int],
        "tsallis_network_forward": [*network, real, pointer, pointer, pointer, size],
        "tsallis_network_backward": [*network, pointer, pointer, pointer, pointer, size],
        "tsallis_log_density": [size, size, *[pointer] * 4],
        "tsallis_log_density_gradient": [size, size, *[pointer] * 6],
        "tsallis_adaterm": [*segments, *[pointer] * 9],
        "tsallis_cat_distance": [*segments, *[pointer] * 4],
        "tsallis_cat": [*segments, *[pointer] * 7],
    }.items():
        function = getattr(library, name)
        function.argtypes = arguments
        function.restype = c_int if name == "tsallis_use_level" else None
    library.tsallis_kept_size.argtypes = [size, size, pointer]
    library.tsallis_kept_size.restype = size


def _load(paths: list[Path]) -> ctypes.CDLL | str:
    """The library, or why it is not used."""
    found = [path for path in paths if path.exists()]
    if not found:
        return "they are not built; python -m torchrl_tsallis.native build does it"
    try:
        library = ctypes.CDLL(str(found[0]))
        version = library.tsallis_version()
    except (OSError, AttributeError) as error:
        return f"{found[0]} cannot be loaded ({error}); build them anew"
    if version != VERSION:
        return f"{found[0]} is of interface {version}, not {VERSION}; build them anew"
    if library.tsallis_level() < 1:
        return "this processor has no AVX2"
    _declare(library)
    return library


def _look() -> ctypes.CDLL | None:
    """Loads the library once a process, and says once why it is not used though it is there or was asked for."""
    global _library, _looked
    if not _looked:
        _looked = True
        loaded = _load(library_paths())
        if isinstance(loaded, ctypes.CDLL):
            _library = loaded
        elif os.environ.get("TSALLIS_NATIVE") == "1":
            logger.warning(f"TSALLIS_NATIVE=1 asks for the native kernels, but {loaded}; torch computes")
        elif any(path.exists() for path in library_paths()):
            logger.info(f"the native kernels are off: {loaded}; torch computes")
    return _library


def forget() -> None:
    """Makes the next use look for the library again, as after a build."""
    global _library, _looked
    _library, _looked = None, False


def active() -> ctypes.CDLL | None:
    """The kernels, where they are built, fit this machine and are not switched off; else None, as for a compiler.

    Examples:
        >>> with used(False):
        ...     active() is None
        True
    """
    return _look() if _used and not torch.compiler.is_compiling() else None


def is_available() -> bool:
    """Whether the kernels are built and fit this machine.

    Examples:
        >>> is_available() in (True, False)
        True
    """
    return _look() is not None


@contextmanager
def used(flag: bool) -> Iterator[None]:
    """Inside, the kernels are used or not, in the whole process.

    Args:
        flag: whether; True does nothing where they are not available.

    Examples:
        >>> with used(False):
        ...     pass
    """
    global _used
    before, _used = _used, flag
    try:
        yield
    finally:
        _used = before


def info() -> str:
    """One line about the kernels: which are used, or why none are.

    Examples:
        >>> isinstance(info(), str)
        True
    """
    if not _used:
        return "off, by TSALLIS_NATIVE=0"
    library = _look()
    if library is not None:
        return f"{LEVELS[library.tsallis_level()]}, {library._name}"
    return f"off: {_load(library_paths())}"
