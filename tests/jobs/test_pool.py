"""The pool of workers: their deaths are named, Ctrl-C and the end of the parent end them, a missing guard is said."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from torchrl_tsallis.jobs import WorkerDiedError, finished_jobs, run_jobs

BAR = {"total": 3, "desc": "counting", "unit": "job", "progress": False}
JOBS = '''
import os
import pathlib
import time


def double(x):
    return 2 * x


def fail(x):
    raise ValueError(f"no {x}")


def die_first(folder, x):
    """Dies once of job 2."""
    mark = pathlib.Path(folder, "died")
    if x == 2 and not mark.exists():
        mark.touch()
        os._exit(1)
    return 2 * x


def die(x):
    if x == 2:
        os._exit(1)
    return 2 * x


def wait(folder, x):
    pathlib.Path(folder, str(os.getpid())).touch()
    time.sleep(600)


def threads(x):
    return os.environ["OMP_NUM_THREADS"]
'''
UNGUARDED = {
    "run_jobs": "run_jobs(abs, [1, 2], workers=2, total=2, desc='counting', unit='job', progress=False)",
    "finished_jobs": "list(finished_jobs(abs, [1, 2], workers=2))",
    "with retries": "list(finished_jobs(abs, [1, 2], workers=2, retries=3))",
}


@pytest.fixture
def jobs(tmp_path, monkeypatch):
    (tmp_path / "jobs_of_pool.py").write_text(JOBS)
    monkeypatch.syspath_prepend(tmp_path)
    import jobs_of_pool as module

    yield module
    monkeypatch.delitem(sys.modules, "jobs_of_pool")


def test_results_are_in_the_order_of_the_jobs_and_workers_have_one_thread(jobs):
    assert run_jobs(jobs.double, [3, 1, 2], workers=2, **BAR) == [6, 2, 4]
    assert run_jobs(jobs.threads, [1], workers=1, **BAR) == ["1"]


@pytest.mark.parametrize("workers", [-1, 2.5, True, None, "2"])
def test_a_number_of_workers_that_is_none_is_refused(workers):
    for run in (partial(run_jobs, **BAR), lambda *args, **kwargs: list(finished_jobs(*args, **kwargs))):
        with pytest.raises((ValueError, TypeError), match="^workers must be an integer of at least [01], got "):
            run(abs, [1], workers=workers)


def test_an_error_of_a_job_is_passed_on(jobs):
    with pytest.raises(ValueError, match="no 1"):
        run_jobs(jobs.fail, [1], workers=1, **BAR)


def test_a_dead_worker_s_jobs_are_named_or_tried_again(jobs, tmp_path):
    with pytest.raises(WorkerDiedError, match="died while counting") as error:
        run_jobs(jobs.die, [2], workers=1, **BAR)
    assert error.value.jobs == [2]
    found = dict(finished_jobs(partial(jobs.die_first, str(tmp_path)), [1, 2, 3], workers=2, retries=1))
    assert found == {1: 2, 2: 4, 3: 6}
    with pytest.raises(WorkerDiedError) as error:
        list(finished_jobs(jobs.die, [1, 2, 3], workers=2, retries=2))
    assert error.value.jobs == [2]  # the others that were under way with it are found to be innocent


@pytest.mark.parametrize("call", UNGUARDED)
def test_a_script_without_a_guard_gets_one_message(call, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(f"from torchrl_tsallis.jobs import finished_jobs, run_jobs\n{UNGUARDED[call]}\n")
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 1
    assert done.stderr.count("Traceback") == 1
    assert 'below the line `if __name__ == "__main__":`' in done.stderr.splitlines()[-1]
    script.write_text(script.read_text().replace("\n", '\nif __name__ == "__main__":\n    ', 1))
    assert subprocess.run([sys.executable, str(script)], check=False, timeout=300).returncode == 0


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL, signal.SIGTERM])
def test_workers_end_with_their_parent(end, jobs, tmp_path):
    script, folder = tmp_path / "script.py", tmp_path / "pids"
    folder.mkdir()
    script.write_text(
        "from functools import partial\nfrom jobs_of_pool import wait\nfrom torchrl_tsallis.jobs import finished_jobs\n"
        f'if __name__ == "__main__":\n    list(finished_jobs(partial(wait, {str(folder)!r}), [1, 2], workers=2))\n'
    )
    process = subprocess.Popen([sys.executable, str(script)], stderr=subprocess.PIPE)
    try:
        while len(list(folder.iterdir())) < 2:
            assert process.poll() is None
            time.sleep(0.05)
        workers = [int(path.name) for path in folder.iterdir()]
        os.kill(process.pid, end)
        process.communicate(timeout=300)
        until = time.monotonic() + 60
        while any(alive(pid) for pid in workers) and time.monotonic() < until:
            time.sleep(0.05)
        assert not any(alive(pid) for pid in workers)
    finally:
        process.kill()
