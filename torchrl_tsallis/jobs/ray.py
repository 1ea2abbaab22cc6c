"""Work on a Ray cluster, by the signature of :func:`torchrl_tsallis.jobs.run_jobs`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from torchrl_tsallis.jobs import pool
from torchrl_tsallis.jobs.pool import Job, Result


def _import_ray() -> Any:
    """Ray, which is an extra."""
    try:
        import ray
    except ImportError as error:
        raise ImportError(
            "launcher=ray needs Ray: install the extra by `pip install torchrl-tsallis[ray]`, or use launcher=local"
        ) from error
    return ray


def _run(function: Callable[[Job], Result], job: Job, queue: Any) -> Result:
    """Runs a job in a worker of Ray, whose ticks go to the queue."""
    pool._QUEUE = queue
    return function(job)


def run_jobs_on_ray(
    function: Callable[[Job], Result],
    jobs: Sequence[Job],
    *,
    total: int,
    desc: str,
    unit: str,
    address: str | None = None,
    resources: Mapping[str, float] | None = None,
    retries: int = 3,
    progress: bool = True,
) -> list[Result]:
    """Runs a function on every job as tasks of Ray.

    A session of Ray that is there already is used and left as it is; one that is started here ends with the jobs. The
    nodes of a cluster need this package, and the files that the jobs name.

    Args:
        function: picklable; calls :func:`torchrl_tsallis.jobs.tick` as it proceeds. It is called again on a job whose
            process or node died.
        jobs: its arguments, picklable.
        total: number of ticks of all jobs.
        desc: text before the progress bar.
        unit: what a tick is.
        address: of a running cluster, or ``"auto"``. Default: None, a cluster of this machine alone is started.
        resources: of a job, as ``num_cpus`` and ``num_gpus``; fractions share a processor. Default: one CPU.
        retries: how often a job whose process died is begun again.
        progress: whether to show the bar.

    Returns:
        The results, in the order of the jobs.

    Raises:
        ImportError: if Ray is missing; the message names the extra.
        Exception: of a job, passed on; the other jobs are stopped then, and after Ctrl-C.
    """
    ray = _import_ray()
    from ray.util.queue import Queue
    from tqdm import tqdm

    started = not ray.is_initialized()
    if started:
        ray.init(address=address, log_to_driver=False, logging_level="error", include_dashboard=False)
    try:
        queue = Queue(actor_options={"num_cpus": 0})
        task = ray.remote(**{"num_cpus": 1, **(resources or {}), "max_retries": retries})(_run)
        futures = [task.remote(function, job, queue) for job in jobs]
        waiting = list(futures)
        with tqdm(total=total, desc=desc, unit=unit, disable=not progress) as bar:
            try:
                while waiting:
                    finished, waiting = ray.wait(waiting, timeout=0.2)
                    ray.get(finished)
                    bar.update(sum(queue.get_nowait_batch(queue.qsize())))
            except BaseException:
                for future in waiting:
                    ray.cancel(future, force=True)
                raise
            bar.update(bar.total - bar.n)
        queue.shutdown()
        return ray.get(futures)
    finally:
        if started:
            ray.shutdown()
