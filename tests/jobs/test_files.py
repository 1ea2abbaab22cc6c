"""Files are whole or not there, and each error of the disk names the file and the way out."""

from __future__ import annotations

import errno
import os

import pytest
import torch

from torchrl_tsallis.jobs import atomic_path, disk_errors

WRITERS = {
    "text": lambda path: path.write_text("x" * 100_000),
    "torch": lambda path: torch.save(torch.zeros(100_000), path),
}


@pytest.mark.parametrize("writer", WRITERS)
def test_a_full_disk_leaves_the_old_file_and_says_what_to_do(writer, tmp_path):
    target = tmp_path / "file.bin"
    target.write_text("old")
    with (
        pytest.raises(OSError, match=r"cannot write '.*file.bin' \(.*\): check .*free space") as error,
        atomic_path(target),
    ):
        WRITERS[writer](type(target)("/dev/full"))
    assert error.value.errno in (errno.ENOSPC, errno.EIO)
    assert [path.name for path in tmp_path.iterdir()] == ["file.bin"] and target.read_text() == "old"


def test_an_error_of_another_kind_is_passed_on_and_nothing_is_published(tmp_path):
    with pytest.raises(ValueError, match="bad value"), atomic_path(tmp_path / "file.bin") as path:
        path.write_text("half")
        raise ValueError("bad value")
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_known_by_the_words_of_safetensors(tmp_path):
    class SafetensorError(Exception):
        pass

    with pytest.raises(OSError, match="cannot write") as error, atomic_path(tmp_path / "a.safetensors"):
        raise SafetensorError("Error while serializing: I/O error: No space left on device (os error 28)")
    assert error.value.errno == errno.ENOSPC
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.EACCES])
def test_errors_of_libraries_become_one_of_the_system(code):
    with (
        pytest.raises(OSError, match="cannot write '/runs/a'.*choose another output folder") as error,
        disk_errors("/runs/a"),
    ):
        raise RuntimeError(f"unable to write to file </x>: {os.strerror(code)} ({code})")
    assert error.value.errno == code


def test_an_error_that_names_its_file_already_keeps_that():
    with pytest.raises(OSError, match="cannot write '/a/b'"), disk_errors("/a"), disk_errors("/a/b"):
        raise OSError(errno.ENOSPC, "No space left on device")
