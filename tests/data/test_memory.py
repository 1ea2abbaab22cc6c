"""Demonstrations on disk may be larger than the memory: nothing makes a whole copy of them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
import sys, threading, time, warnings
import torch
from tensordict import TensorDict
from torchrl_tsallis.data import *
from torchrl_tsallis.data.readers import read_demonstrations

warnings.simplefilter("ignore")
folder, n, t = sys.argv[1], 5_000, torch.arange(5_000)
for dtype, width in ((torch.float32, 4096), (torch.uint8, 16384)):
    values = torch.randint(0, 99, (1, width)).to(dtype).expand(n, width)
    data = TensorDict({"observation": values, "action": torch.rand(n, 2), "is_init": t % 100 == 0}, [n])
    data["next"] = TensorDict({"done": t % 100 == 99}, [n])
    place = f"{folder}/{dtype}"
    data.memmap(place, copy_existing=True)
    data = read_demonstrations(place).data
    keys = ("observation", "action", "is_init")
    twice = [data, data.copy()]
    calls = {
        "validate": lambda: validate_demonstrations(data),
        "pairs": lambda: make_replay_buffer(data),
        "slices": lambda: make_sequence_buffer(data, slice_len=100, num_slices=1, keys=keys),
        "stacked": lambda: make_stacked_replay_buffer(twice, seeds=[0, 1], scratch_dir=place + "-scratch"),
        "again": lambda: make_stacked_replay_buffer(twice, seeds=[0, 1], scratch_dir=place + "-scratch"),
        "split": lambda: split_episodes(data, 0.5),
        "robust": lambda: RobustScaling.fit(data)(data),
        "inspect": lambda: inspect_demonstrations(data),
    }
    if dtype == torch.float32:
        calls["scaling"] = lambda: Scaling.fit(data, action_unit=1.0)(data)

    def anonymous():
        return next(int(line.split()[1]) / 1024 for line in open("/proc/self/status") if line.startswith("RssAnon"))

    for name, call in calls.items():
        base, peak, over = anonymous(), [0.0], threading.Event()

        def watch():
            while not over.wait(0.002):
                peak[0] = max(peak[0], anonymous())

        thread = threading.Thread(target=watch)
        thread.start()
        call()
        over.set()
        thread.join()
        print(name, dtype, max(0, round(peak[0] - base)))
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads Linux's account of a process")
def test_data_on_disk_costs_at_most_64_mib(tmp_path):
    done = subprocess.run([sys.executable, "-c", SCRIPT, str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    grown = [line.rsplit(" ", 1) for line in done.stdout.splitlines()]
    assert len(grown) == 17
    assert {name: int(size) for name, size in grown if int(size) > 64} == {}, done.stdout
