from __future__ import annotations

import numpy as np
import pytest

from torchrl_tsallis.envs import make_ant
from torchrl_tsallis.evaluation.video import record_rollout


def still(observation):
    return np.zeros(8)


def test_bad_arguments():
    with pytest.raises(ValueError, match="use .gif or .mp4"):
        record_rollout(still, "x.png", env_fn=make_ant)
    with pytest.raises(ValueError, match="fps=0"):
        record_rollout(still, "x.gif", env_fn=make_ant, fps=0)


@pytest.mark.filterwarnings("ignore")
def test_gif_frames_and_size(tmp_path):
    image = pytest.importorskip("PIL.Image")
    pytest.importorskip("pybullet")
    path = record_rollout(
        still, tmp_path / "ant.gif", env_fn=make_ant, step_seconds=0.0165, seconds=0.3, fps=10, size=(64, 48)
    )
    with image.open(path) as gif:
        # frames at 0, 0.1 and 0.2 s
        assert (gif.size, gif.n_frames) == ((64, 48), 3)
