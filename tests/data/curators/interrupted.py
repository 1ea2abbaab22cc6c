"""Curates in child processes that are killed, or may write no more: `python interrupted.py JOBS`, a file of JSON.

A job is `[rating's folder, copy, "kill" or "full", number]`: killed at the number-th file that is opened to be written
(at the first or second move if -1 or -2), or with files of so many bytes at most. One line of JSON a job goes to the
standard output: the signal that ended it, and the error.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import traceback
from pathlib import Path

import h5py  # noqa: F401 - once, and not in every child
import pyarrow.parquet  # noqa: F401

from torchrl_tsallis.data.curation import curate


def _kill_at(place: str, number: int) -> None:
    count, moves = 0, 0

    def hook(event: str, args: tuple) -> None:
        nonlocal count, moves
        if event == "os.rename" and "unfinished" in f"{args[0]} {args[1]}" and number < 0:
            moves -= 1
            if moves == number:
                os.kill(os.getpid(), signal.SIGKILL)
        if event == "open" and str(args[0]).startswith(place) and "unfinished" in str(args[0]):
            writes = args[2] & (os.O_WRONLY | os.O_RDWR) if isinstance(args[2], int) else False
            count += bool(writes)
            if writes and count == number:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)


def _child(folder: str, out: str, how: str, number: int, pipe: int) -> None:
    error = ""
    try:
        if how == "kill":
            _kill_at(str(Path(out).parent), number)
        else:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (number, number))
        curate(folder, out, share=0.5, overwrite=True)
    except OSError as caught:
        error = str(caught)
    except BaseException:
        error = traceback.format_exc()
    os.write(pipe, error.encode())
    os._exit(0)


if __name__ == "__main__":
    for job in json.loads(Path(sys.argv[1]).read_text()):
        read, write = os.pipe()
        child = os.fork()
        if not child:
            _child(*job, write)
        os.close(write)
        with os.fdopen(read) as stream:
            text = stream.read()
        _, status = os.waitpid(child, 0)
        sys.stdout.write(
            json.dumps({"signal": os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0, "error": text}) + "\n"
        )
