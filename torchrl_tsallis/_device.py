"""Where tensors are put."""

from __future__ import annotations

import torch


def check_device(device: str | torch.device) -> torch.device:
    """The device, once a tensor could be put there.

    Raises:
        ValueError: if there is no such device here.

    Examples:
        >>> check_device("cpu")
        device(type='cpu')
    """
    try:
        found = torch.device(device)
        torch.zeros(1, device=found).cpu()
    except (RuntimeError, AssertionError, NotImplementedError, TypeError) as error:
        raise ValueError(f"device={device!r} is not there, or torch was installed without it: take 'cpu'") from error
    return found
