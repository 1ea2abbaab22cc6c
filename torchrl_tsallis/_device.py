"""Where tensors are put."""

from __future__ import annotations

import torch

from torchrl_tsallis._checks import shown


def check_device(device: str | torch.device) -> torch.device:
    """The device, once a tensor could be put there.

    Raises:
        TypeError: if it is neither text nor a ``torch.device``.
        ValueError: if there is no such device here.

    Examples:
        >>> check_device("cpu")
        device(type='cpu')
    """
    if not isinstance(device, (str, torch.device)):
        raise TypeError(f"device={shown(device)} must be text such as 'cuda', or a torch.device")
    try:
        found = torch.device(device)
        torch.zeros(1, device=found).cpu()
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise ValueError(
            f"device={shown(device)} is not there, or torch was installed without it: take 'cpu'"
        ) from error
    return found
