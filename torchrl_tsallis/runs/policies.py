"""Policies of scaled data in the units of the data: as a network, and with NumPy alone."""

from __future__ import annotations

import importlib.util
import logging
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_tsallis.data.robust_scaling import RobustScaling
from torchrl_tsallis.evaluation.mean_policy import MeanPolicy
from torchrl_tsallis.jobs.files import atomic_path


class ScaledNetwork(nn.Module):
    """A network of scaled observations and actions, from and to the units of the data.

    Args:
        network: maps the scaled observation ``[*B, O]`` to mean and scale of the scaled action, ``[*B, A]`` each.
        scaling: of ``observation`` and ``action``.

    Examples:
        >>> centre, scale = torch.tensor([1.0]), torch.tensor([2.0])
        >>> scaling = RobustScaling(*({"observation": x, "action": x} for x in (centre, scale)))
        >>> class Same(nn.Module):
        ...     def forward(self, x):
        ...         return x, torch.ones_like(x)
        >>> ScaledNetwork(Same(), scaling)(torch.tensor([[5.0]]))
        (tensor([[5.]]), tensor([[2.]]))
    """

    observation_centre: Tensor
    observation_scale: Tensor
    action_centre: Tensor
    action_scale: Tensor

    def __init__(self, network: nn.Module, scaling: RobustScaling) -> None:
        super().__init__()
        self.network = network
        for key in ("observation", "action"):
            self.register_buffer(f"{key}_centre", scaling.centres[key].float())
            self.register_buffer(f"{key}_scale", scaling.scales[key].float())

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        """Maps ``[*B, O]`` to mean and scale of the action, ``[*B, A]`` each."""
        loc, scale = self.network((observation - self.observation_centre) / self.observation_scale)
        return loc * self.action_scale + self.action_centre, scale * self.action_scale


class MeanNetwork(nn.Module):
    """The mean alone of a :class:`ScaledNetwork`: what a robot runs.

    Args:
        network: whose mean it is.
    """

    def __init__(self, network: ScaledNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, observation: Tensor) -> Tensor:
        """Maps ``[*B, O]`` to the mean action ``[*B, A]``."""
        return self.network(observation)[0]


class ScaledMeanPolicy:
    """The imitator's mean action with NumPy alone, in the units of the data.

    Args:
        policy: of scaled data.
        constants: centre and scale of ``observation`` and of ``action``, in this order.

    Examples:
        >>> policy = MeanPolicy([(np.ones((2, 1)), np.zeros(2), None)])
        >>> ScaledMeanPolicy(policy, [np.array([v]) for v in (1.0, 2.0, 0.0, 10.0)])(np.array([5.0]))
        array([20.], dtype=float32)
    """

    batched = True

    def __init__(self, policy: MeanPolicy, constants: list[np.ndarray]) -> None:
        self.policy = policy
        self.constants = constants

    @classmethod
    def of(cls, state: Mapping[str, Any], scaling: RobustScaling) -> ScaledMeanPolicy:
        """Of the state of an actor of ``make_policy``, and the scaling of its data."""
        constants = [v[key].numpy() for key in ("observation", "action") for v in (scaling.centres, scaling.scales)]
        return cls(MeanPolicy.from_actor_state(state), constants)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Maps an observation ``[*B, O]`` to the mean action ``[*B, A]``, float32."""
        centre, scale, zero, unit = self.constants
        mean = self.policy((np.asarray(observation, np.float64) - centre) / scale)
        return (mean * unit + zero).astype(np.float32)


@contextmanager
def _quiet() -> Iterator[None]:
    """Torch's exporters warn of themselves, and of packages that the policy does not need."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)


def export_onnx(network: ScaledNetwork, path: str | os.PathLike[str], *, overwrite: bool = False) -> float | None:
    """Writes the mean policy, with its scaling inside, as ONNX: ``observation`` ``[B, O]`` to ``action`` ``[B, A]``.

    Args:
        network: of a run.
        path: the file.
        overwrite: whether a file that is there is replaced.

    Returns:
        The largest difference between onnxruntime's actions and torch's, in the actions' scales, on 64 observations
        about the data's centre; None where onnxruntime is not installed.

    Raises:
        FileExistsError: if there is something at ``path``.
        ImportError: if torch's exporter lacks its packages; the message names them.
        RuntimeError: if onnxruntime gives other actions; nothing is written then.
    """
    path = Path(path).expanduser()
    if path.is_dir() or (path.exists() and not overwrite):
        raise FileExistsError(f"{str(path)!r} exists: choose another file, or replace it (overwrite=True, --overwrite)")
    missing = [name for name in ("onnx", "onnxscript") if importlib.util.find_spec(name) is None]
    if missing:
        raise ImportError(f"the export to ONNX needs {' and '.join(missing)}: pip install {' '.join(missing)}")
    mean = MeanNetwork(network).eval()
    generator = torch.Generator().manual_seed(0)
    centre, scale = network.get_buffer("observation_centre"), network.get_buffer("observation_scale")
    x = centre + scale * torch.randn(64, len(centre), generator=generator)
    shapes = ({0: torch.export.Dim("batch")},)
    with atomic_path(path) as temporary, torch.no_grad():
        with _quiet():
            torch.onnx.export(
                mean,
                (x,),
                str(temporary),
                dynamo=True,
                input_names=["observation"],
                output_names=["action"],
                dynamic_shapes=shapes,
                external_data=False,
                verbose=False,
            )
        if importlib.util.find_spec("onnxruntime") is None:
            return None
        import onnxruntime

        (got,) = onnxruntime.InferenceSession(str(temporary)).run(None, {"observation": x.numpy()})
        apart = (torch.from_numpy(got) - mean(x)) / network.get_buffer("action_scale")
        most = float(apart.abs().max())
        if not most <= 1e-3:
            raise RuntimeError(f"onnxruntime's actions differ by {most:.3g} scales from torch's: nothing is written")
    return most
