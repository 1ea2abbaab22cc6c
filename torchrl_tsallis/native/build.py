"""Builds the kernels by torch's extension builder, when it is asked to."""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
import tempfile
from pathlib import Path

from torchrl_tsallis.native.library import SOURCES, built_path, forget

#: The sources choose the instruction set themselves, by attributes of functions: no flag does.
FLAGS = ["-O3", "-std=c++17", "-fno-math-errno", "-w"]


class BuildError(RuntimeError):
    """Why the kernels cannot be built here; the library goes on without them."""


def build(path: Path | None = None) -> Path:
    """Compiles the kernels.

    Args:
        path: of the library. Default: None, where it will be looked for.

    Returns:
        The path.

    Raises:
        BuildError: without an x86 processor, a C++ compiler or ninja, and if the compiler fails; says what to do.
    """
    path = built_path() if path is None else path
    if platform.machine().lower() not in ("x86_64", "amd64") or platform.system() != "Linux":
        raise BuildError(
            f"the native kernels are written for Linux on x86-64, this is {platform.system()} on {platform.machine()}: "
            "nothing was built, and torch computes as before"
        )
    compiler = os.environ.get("CXX") or "c++"
    if shutil.which(shlex.split(compiler)[0]) is None:
        raise BuildError(f"no C++ compiler {compiler!r}: install one, such as the package g++, or name another by CXX")
    if shutil.which("ninja") is None:
        raise BuildError("no ninja, by which torch builds: install the package ninja, or torchrl-tsallis[native]")
    from torch.utils import cpp_extension

    with tempfile.TemporaryDirectory() as folder:
        try:
            cpp_extension.load(
                "tsallis_kernels",
                [str(SOURCES / "kernels.cpp")],
                extra_cflags=FLAGS,
                extra_ldflags=["-pthread"],
                build_directory=folder,
                is_python_module=False,
            )
            path.parent.mkdir(parents=True, exist_ok=True)
            part = path.with_name(f".{path.name}.{os.getpid()}")
            shutil.copyfile(Path(folder) / "tsallis_kernels.so", part)
            os.replace(part, path)
        except (RuntimeError, OSError, subprocess.SubprocessError) as error:
            raise BuildError(f"the native kernels were not built, torch computes as before: {error}") from error
    forget()
    return path
