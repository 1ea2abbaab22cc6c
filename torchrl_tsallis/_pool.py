"""Work in processes of one thread each, with one progress bar that all of them advance."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

Job = TypeVar("Job")
Result = TypeVar("Result")

_QUEUE: Any = None  # of a worker process: how it tells of its progress


def tick(count: int = 1) -> None:
    """Advances the progress bar from within a job; does nothing outside of one."""
    if _QUEUE is not None:
        _QUEUE.put(count)


def prepare_worker() -> None:
    """Prepares a worker process: one thread, no reaction to Ctrl-C, and an end with its main process."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes of a terminal; the main one decides

    def end() -> None:
        parent.join()
        os._exit(1)  # a worker whose main process was killed would go on beside the resumed run

    threading.Thread(target=end, daemon=True).start()


def terminate_workers() -> None:
    """Ends this process's workers at once, in the middle of what they do."""
    for process in multiprocessing.active_children():
        process.terminate()


def _start(queue: Any) -> None:
    """Prepares a worker process of :func:`run_jobs`."""
    global _QUEUE
    _QUEUE = queue
    prepare_worker()


class _Bar:
    """Stands where :func:`tick` expects the queue of a worker process."""

    def __init__(self, bar: Any) -> None:
        self.bar = bar

    def put(self, count: int) -> None:
        """Advances the bar."""
        self.bar.update(count)


def run_jobs(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    *,
    workers: int,
    total: int,
    desc: str,
    unit: str,
    progress: bool = True,
) -> list[Result]:
    """Runs a function on every job, in worker processes.

    Args:
        function: picklable; calls :func:`tick` as it proceeds.
        jobs: its arguments, picklable.
        workers: number of processes; 0 runs the jobs in this one.
        total: number of ticks of all jobs.
        desc: text before the progress bar.
        unit: what a tick is.
        progress: whether to show the bar.

    Returns:
        The results, in the order of the jobs.

    Raises:
        RuntimeError: if a worker process dies; the message says so. An exception of a job is passed on. The other
            jobs are stopped in either case, and after Ctrl-C.
    """
    from tqdm import tqdm

    if workers == 0:
        global _QUEUE
        with tqdm(total=total, desc=desc, unit=unit, disable=not progress) as bar:
            _QUEUE = _Bar(bar)
            try:
                return [function(job) for job in jobs]
            finally:
                _QUEUE = None
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    pool = ProcessPoolExecutor(workers, context, _start, (queue,))
    with tqdm(total=total, desc=desc, unit=unit, disable=not progress) as bar:
        futures = [pool.submit(function, job) for job in jobs]
        waiting = set(futures)
        try:
            while waiting:
                finished, waiting = wait(waiting, timeout=0.2)
                for future in finished:
                    future.result()
                while not queue.empty():
                    bar.update(queue.get())
        except BaseException as error:
            pool.shutdown(wait=False, cancel_futures=True)
            terminate_workers()
            if isinstance(error, BrokenProcessPool):
                raise RuntimeError(
                    f"a worker process died while {desc} (killed, or out of memory): try again with fewer workers"
                ) from error
            raise
        bar.update(bar.total - bar.n)
    pool.shutdown()
    return [future.result() for future in futures]
