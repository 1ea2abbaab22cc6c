"""Jobs on a cluster of Ray, and its absence."""

from __future__ import annotations

import sys
import warnings

import pytest

from torchrl_tsallis.jobs import run_jobs, run_jobs_on_ray, tick

BAR = {"total": 6, "desc": "counting", "unit": "tick", "progress": False}


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError, match=r"torchrl-tsallis\[ray\]"):
        run_jobs_on_ray(abs, [1], **BAR)


def test_no_worker_runs_the_jobs_in_this_process(capsys):
    pytest.importorskip("tqdm")
    seen = []

    def job(x: int) -> int:
        tick(2)
        seen.append(x)
        return -x

    assert run_jobs(job, [1, 2, 3], workers=0, **(BAR | {"progress": True})) == [-1, -2, -3]
    assert seen == [1, 2, 3]
    assert "6/6" in capsys.readouterr().err


@pytest.mark.slow
def test_jobs_on_a_local_cluster(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Ray's own
        ray = pytest.importorskip("ray")

        def job(x: int) -> int:
            import os

            tick(2)
            if x < 0:
                raise ValueError(f"no {x}")
            mark = tmp_path / f"died_{x}"
            if x == 2 and not mark.exists():
                mark.touch()
                os._exit(1)  # as a node that is lost: the job is begun again
            return 10 * x

        ray.init(num_cpus=2, num_gpus=1, include_dashboard=False, log_to_driver=False, logging_level="error")
        try:
            resources = {"num_cpus": 0.5, "num_gpus": 0.25}
            assert run_jobs_on_ray(job, [1, 2, 3], resources=resources, **BAR) == [10, 20, 30]
            with pytest.raises(ValueError, match="no -1"):
                run_jobs_on_ray(job, [-1], resources=resources, **BAR)
        finally:
            ray.shutdown()
