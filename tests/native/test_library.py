"""Where the kernels come from, and what is said where they cannot be used."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import pytest
import torch
from tensordict import TensorDict

from torchrl_tsallis import AdaTerm, CATSoftUpdate, PeakRating, TsallisBCLoss, native
from torchrl_tsallis.modules import make_policy
from torchrl_tsallis.native import __main__ as command
from torchrl_tsallis.native import build as builder
from torchrl_tsallis.native import library


@pytest.fixture
def said(monkeypatch):
    """What is logged, of a process that has not looked for the kernels yet."""
    lines = []
    for name in ("info", "warning"):
        monkeypatch.setattr(library.logger, name, lambda text: lines.append(text))
    monkeypatch.setattr(library, "_used", True)
    monkeypatch.delenv("TSALLIS_NATIVE", raising=False)
    library.forget()
    yield lines
    library.forget()


def test_without_a_build_torch_computes_in_silence(said, monkeypatch, tmp_path):
    monkeypatch.setattr(library, "library_paths", lambda: [tmp_path / "none.so"])
    assert library.active() is None
    assert not native.is_available()
    assert said == []
    assert "python -m torchrl_tsallis.native build" in native.info()


def test_who_asks_for_them_is_told_once_that_they_are_not_built(said, monkeypatch, tmp_path):
    monkeypatch.setattr(library, "library_paths", lambda: [tmp_path / "none.so"])
    monkeypatch.setenv("TSALLIS_NATIVE", "1")
    assert library.active() is library.active() is None
    assert len(said) == 1
    assert "python -m torchrl_tsallis.native build" in said[0]


@pytest.mark.parametrize("content", [b"", b"no library", b"\x7fELF" + bytes(100)], ids=["empty", "text", "cut"])
def test_a_file_that_is_no_library_is_said_once(said, monkeypatch, tmp_path, content):
    path = tmp_path / "kernels.so"
    path.write_bytes(content)
    monkeypatch.setattr(library, "library_paths", lambda: [path])
    assert library.active() is library.active() is None
    assert len(said) == 1
    assert str(path) in said[0]
    assert "build" in said[0]


def test_a_library_of_another_interface_or_processor_is_said_once(said, monkeypatch, built):
    monkeypatch.setattr(library, "library_paths", lambda: [built])
    monkeypatch.setattr(library, "VERSION", -1)
    assert library.active() is None
    assert "not -1" in said[0]
    monkeypatch.undo()


def test_a_processor_without_avx2_gets_torch(said, monkeypatch, built):
    monkeypatch.setattr(library, "library_paths", lambda: [built])
    loaded = library.active()
    loaded.tsallis_use_level(0)
    library.forget()
    try:
        assert library.active() is None
        assert said == ["the native kernels are off: this processor has no AVX2; torch computes"]
    finally:
        loaded.tsallis_use_level(len(library.LEVELS) - 1)


def test_they_are_found_where_build_puts_them_and_used_until_switched_off(said, monkeypatch, built, tmp_path):
    monkeypatch.setenv("TSALLIS_NATIVE_DIR", str(tmp_path))
    shutil.copyfile(built, library.built_path())
    assert native.is_available()
    assert str(tmp_path) in native.info()
    with native.used(False):
        assert library.active() is None
    assert library.active() is not None


def test_the_environment_switches_them_off():
    code = "from torchrl_tsallis import native; print(native.info(), native.active())"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"TSALLIS_NATIVE": "0"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "off, by TSALLIS_NATIVE=0 None"


@pytest.mark.parametrize(
    ("what", "named"),
    [("compiler", "no C\\+\\+ compiler 'no-such-compiler'.*CXX"), ("ninja", "no ninja.*torchrl-tsallis\\[native\\]"),
     ("machine", "this is Linux on arm64.*torch computes"), ("system", "this is Plan9.*torch computes")],
)  # fmt: skip
def test_why_they_cannot_be_built_is_said_with_the_way_out(monkeypatch, tmp_path, capsys, what, named):
    if what == "compiler":
        monkeypatch.setenv("CXX", "no-such-compiler")
    elif what == "ninja":
        monkeypatch.setattr(builder.shutil, "which", lambda name: None if name == "ninja" else "/usr/bin/c++")
    else:
        monkeypatch.setattr(builder.platform, what, lambda: {"machine": "arm64", "system": "Plan9"}[what])
    with pytest.raises(builder.BuildError, match=named):
        builder.build(tmp_path / "kernels.so")
    monkeypatch.setattr(sys, "argv", ["native", "build"])
    assert command.main() == 1
    assert capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_compiler_that_fails_leaves_nothing(monkeypatch, built, tmp_path):
    monkeypatch.setattr(builder, "SOURCES", tmp_path / "src")
    (tmp_path / "src").mkdir()
    (tmp_path / "src" / "kernels.cpp").write_text("this is no C++")
    with pytest.raises(builder.BuildError, match="torch computes as before"):
        builder.build(tmp_path / "kernels.so")
    assert [path.name for path in tmp_path.iterdir()] == ["src"]


METHODS = {
    "plain": lambda: {"q": 1.0, "gamma_mix": 0.0},
    "proposal": lambda: {},
    "peak": lambda: {"rating": PeakRating()},
}


@pytest.mark.parametrize("members", [None, 3])
@pytest.mark.parametrize("method", METHODS)
def test_a_training_is_the_same_with_and_without_them(kernels, method, members):
    found = []
    for flag in (True, False):
        torch.manual_seed(0)
        policies = [make_policy(4, 2, hidden=(20, 20)) for _ in range(members or 1)]
        loss = TsallisBCLoss(policies if members else policies[0], **METHODS[method]())
        optimizer = AdaTerm(loss.parameters(), lr=3e-3, batch_dims=0 if members is None else 1)
        updater = CATSoftUpdate(loss)
        tuner = None if method == "plain" else loss.rating_module.tuner()(loss)
        shape = [32] if members is None else [members, 32]
        with native.used(flag):
            for _ in range(30):
                observation = torch.randn(*shape, 4)
                data = TensorDict({"observation": observation, "action": observation[..., :2].sin()}, shape)
                optimizer.zero_grad()
                loss(data)["loss_tsallis_bc"].backward()
                optimizer.step()
                updater.step()
                _ = tuner and tuner.step()
            found.append([*(p.detach() for p in loss.parameters()), loss.rating(data)])
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4)
