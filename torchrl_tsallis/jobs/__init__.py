"""Work in processes, on this machine or a cluster, and files that are whole or not there."""

from __future__ import annotations

from torchrl_tsallis.jobs.files import atomic_path, check_writable, disk_errors
from torchrl_tsallis.jobs.pool import WorkerDiedError, finished_jobs, run_jobs, tick
from torchrl_tsallis.jobs.ray import run_jobs_on_ray

__all__ = [
    "WorkerDiedError",
    "atomic_path",
    "check_writable",
    "disk_errors",
    "finished_jobs",
    "run_jobs",
    "run_jobs_on_ray",
    "tick",
]
