"""The one pool of worker processes: one thread each, ended with their parent, stopped by Ctrl-C."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from torchrl_tsallis._checks import check_callable, check_flag, check_instance, check_number, check_text

Job = TypeVar("Job")
Result = TypeVar("Result")

_QUEUE: Any = None  # of a worker process: how it tells of its progress
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
_UNGUARDED = "TORCHRL_TSALLIS_UNGUARDED"  # names the file by which a worker tells that the script has no guard


class WorkerDiedError(RuntimeError):
    """A worker process died, of no exception of Python.

    Attributes:
        jobs: those that were being done.
    """

    def __init__(self, message: str, jobs: Sequence[Any]) -> None:
        super().__init__(message)
        self.jobs = list(jobs)


def tick(count: int = 1) -> None:
    """Advances the progress bar from within a job; does nothing outside of one."""
    if _QUEUE is not None:
        _QUEUE.put(count)


def _prepare(queue: Any, initializer: Callable[..., None] | None, initargs: tuple[Any, ...]) -> None:
    """Prepares a worker process: one thread, no reaction to Ctrl-C, and an end with its main process."""
    global _QUEUE
    _QUEUE = queue
    parent = multiprocessing.parent_process()
    if parent is not None:
        if "torch" in sys.modules:
            sys.modules["torch"].set_num_threads(1)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes of a terminal; the main one decides

        def end() -> None:
            parent.join()
            os._exit(1)  # a worker whose main process was killed would go on beside the resumed run

        threading.Thread(target=end, daemon=True).start()
    if initializer is not None:
        initializer(*initargs)


def _end_if_unguarded() -> None:
    """Ends a worker that runs the main script once more, before it was given its first job.

    A worker imports the main script, to find its functions there. Without ``if __name__ == "__main__":`` that starts
    the work again inside of the worker, whose traceback of a hundred lines, times the workers, tells nobody the reason.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        mark = os.environ.get(_UNGUARDED)
        if mark:
            Path(mark).touch()
            os._exit(1)


@contextmanager
def _environment(mark: str) -> Iterator[None]:
    """Lets processes started inside use one thread each, and know how to tell that the script has no guard."""
    saved = {key: os.environ.get(key) for key in (*_THREADS, _UNGUARDED)}
    os.environ.update({**dict.fromkeys(_THREADS, "1"), _UNGUARDED: mark})
    try:
        yield
    finally:
        for key, value in saved.items():
            if value is None:
                os.environ.pop(key, None)
            else:
                os.environ[key] = value


def _terminate(pool: ProcessPoolExecutor) -> None:
    """Ends the workers of a pool at once, in the middle of what they do."""
    processes = list((getattr(pool, "_processes", None) or {}).values())  # terminate_workers() is of Python 3.14
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.terminate()


def finished_jobs(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    *,
    workers: int,
    retries: int = 0,
    split: Callable[[Job], list[Job]] | None = None,
    initializer: Callable[..., None] | None = None,
    initargs: tuple[Any, ...] = (),
    ticked: Callable[[int], Any] | None = None,
) -> Iterator[tuple[Job, Result]]:
    """Runs a function on every job in worker processes, and yields the results as they come.

    Args:
        function: picklable; may call :func:`tick` as it proceeds.
        jobs: its arguments, picklable.
        workers: number of processes, at least 1.
        retries: how often a job is begun again whose worker died. The jobs that were under way then are tried one at a
            time, to find the culprit.
        split: makes smaller jobs of one that is tried again. Default: None, it stays whole.
        initializer: called once in each process, before its first job.
        initargs: its arguments.
        ticked: gets the counts of :func:`tick`. Default: None.

    Yields:
        Jobs with their results, in the order in which they are done.

    Raises:
        WorkerDiedError: if a worker died more than ``retries`` times; it names the jobs.
        RuntimeError: if the main script starts the work outside of ``if __name__ == "__main__":``.
        Exception: of a job, passed on. The other jobs are stopped then, and after Ctrl-C.
    """
    _end_if_unguarded()
    check_number("workers", workers, low=1, integer=True)
    check_number("retries", retries, low=0, integer=True)
    waiting = deque((job, 0) for job in jobs)  # with the number of its workers' deaths
    suspects: deque[tuple[Job, int]] = deque()
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory(prefix="torchrl-tsallis-") as folder, _environment(f"{folder}/unguarded"):
        while waiting or suspects:
            queue = context.Queue() if ticked else None
            pool = ProcessPoolExecutor(workers, context, _prepare, (queue, initializer, initargs))
            flying: dict[Future, tuple[Job, int]] = {}
            try:
                while waiting or suspects or flying:
                    source = suspects or waiting
                    while source and len(flying) < workers:
                        if flying and (suspects or any(deaths for _, deaths in flying.values())):
                            break  # a suspect runs alone
                        flying[pool.submit(function, source[0][0])] = source[0]
                        source.popleft()
                    for future in wait(flying, timeout=0.2 if ticked else None, return_when=FIRST_COMPLETED).done:
                        result = future.result()
                        yield flying.pop(future)[0], result
                    while ticked and queue is not None and not queue.empty():
                        ticked(queue.get())
                pool.shutdown()
            except BrokenProcessPool as error:
                pool.shutdown(wait=True, cancel_futures=True)
                if Path(folder, "unguarded").exists():
                    raise RuntimeError(
                        "the script starts worker processes as it is imported: put what it does below the line "
                        '`if __name__ == "__main__":`, or use workers=0'
                    ) from None
                lost = [job for job, deaths in flying.values() if deaths >= retries]
                if lost:
                    raise WorkerDiedError("a worker process died (killed, or out of memory)", lost) from error
                for job, deaths in flying.values():
                    suspects.extend((part, deaths + 1) for part in (split(job) if split else [job]))
            except BaseException:
                _terminate(pool)
                raise


class _Bar:
    """Stands where :func:`tick` expects the queue of a worker process."""

    def __init__(self, bar: Any) -> None:
        self.bar = bar

    def put(self, count: int) -> None:
        """Advances the bar."""
        self.bar.update(count)


def _of_numbered(function: Callable[[Job], Result], job: tuple[int, Job]) -> Result:
    """Calls a function of jobs on a numbered job."""
    return function(job[1])


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
    """Runs a function on every job, in worker processes, with one progress bar that all of them advance.

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
        WorkerDiedError: if a worker process dies; the message says so. An exception of a job is passed on. The other
            jobs are stopped in either case, and after Ctrl-C.
        RuntimeError: if the main script starts the work outside of ``if __name__ == "__main__":``.
    """
    from tqdm import tqdm

    _end_if_unguarded()
    check_callable("function", function, "does a job")
    check_instance("jobs", jobs, Sequence, "a sequence of jobs")
    check_number("workers", workers, low=0, integer=True)
    check_number("total", total, low=0, integer=True)
    check_text("desc", desc)
    check_text("unit", unit)
    check_flag("progress", progress)
    with tqdm(total=total, desc=desc, unit=unit, disable=not progress) as bar:
        if workers == 0:
            global _QUEUE
            _QUEUE = _Bar(bar)
            try:
                return [function(job) for job in jobs]
            finally:
                _QUEUE = None
        results: dict[int, Result] = {}
        numbered, options = list(enumerate(jobs)), {"workers": workers, "ticked": bar.update}
        try:
            for (number, _), result in finished_jobs(partial(_of_numbered, function), numbered, **options):
                results[number] = result
        except WorkerDiedError as error:
            raise WorkerDiedError(
                f"a worker process died while {desc} (killed, or out of memory): try again with fewer workers",
                [job for _, job in error.jobs],
            ) from error
        bar.update(bar.total - bar.n)
    return [results[number] for number in range(len(jobs))]
