"""Two processes with half of each batch train as one with the whole of it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from torchrl_tsallis.ratings.distributed import num_processes

SCRIPT = Path(__file__).parent / "data_parallel_small.py"


@pytest.mark.skipif(not torch.distributed.is_available(), reason="torch was built without distributed")
@pytest.mark.slow
def test_two_processes_equal_one_with_the_whole_batch(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(SCRIPT.parent))
    import data_parallel_small as small

    store = tmp_path / "store"
    other = subprocess.Popen([sys.executable, str(SCRIPT), "1", str(store)], stderr=subprocess.PIPE, text=True)
    try:
        together = small.train_in_parallel(0, str(store))
        _, err = other.communicate(timeout=900)
    finally:
        other.kill()
    assert other.returncode == 0, err
    assert num_processes() == 1
    for case in small.CASES:
        alone = small.train(case)
        assert set(alone) == set(together[case])
        for name, value in alone.items():
            torch.testing.assert_close(together[case][name], value, rtol=1e-9, atol=1e-12, msg=f"{case}: {name}")
    gammas = [together["masked"][f"gamma_mix of step {step}"].item() for step in range(small.STEPS)]
    assert any(0.1 < gamma < 0.9 for gamma in gammas), gammas  # clipped ones would agree in any case
