"""The kernels, built once for these tests where there is a compiler."""

from __future__ import annotations

import os
import shutil

import pytest

from torchrl_tsallis import native
from torchrl_tsallis.native import library
from torchrl_tsallis.native.build import build


@pytest.fixture(scope="session")
def built(tmp_path_factory):
    """The library's path."""
    missing = [name for name in (os.environ.get("CXX", "c++"), "ninja") if shutil.which(name) is None]
    if missing:
        pytest.skip(f"no {missing[0]} to build the native kernels with")
    return build(tmp_path_factory.mktemp("native") / "kernels.so")


@pytest.fixture(params=["AVX2", "AVX-512"])
def kernels(built, monkeypatch, request):
    """The kernels, of one instruction set."""
    monkeypatch.setattr(library, "library_paths", lambda: [built])
    library.forget()
    loaded, level = library.active(), library.LEVELS.index(request.param)
    if loaded is None or loaded.tsallis_use_level(level) != level:
        pytest.skip(f"this processor has no {request.param}")
    with native.used(True):
        yield loaded
    loaded.tsallis_use_level(len(library.LEVELS) - 1)
    library.forget()
