"""In which numbers, and in which form, a module computes."""

from __future__ import annotations

import torch
from torch import Tensor

_HALF = (torch.float16, torch.bfloat16)


def is_traced() -> bool:
    """Whether a compiler, exporter or tracer is looking: it gets the plain formula, which it can fuse and write down.

    Examples:
        >>> is_traced()
        False
    """
    return torch.compiler.is_compiling() or torch.jit.is_tracing() or torch.onnx.is_in_onnx_export()


def is_watched() -> bool:
    """Whether a compiler, exporter, tracer or function transform such as ``torch.vmap`` is looking.

    Examples:
        >>> is_watched(), torch.vmap(lambda x: x if is_watched() else -x)(torch.ones(1))
        (False, tensor([1.]))
    """
    return is_traced() or torch._C._functorch.peek_interpreter_stack() is not None


def widened(x: Tensor) -> Tensor:
    """Half-precision numbers as float32, as torch's own layers compute inside; others as they are.

    A square in float16 is infinite beyond 255, and bfloat16 has three digits.

    Examples:
        >>> widened(torch.ones(2, dtype=torch.bfloat16)).dtype, widened(torch.ones(2, dtype=torch.float64)).dtype
        (torch.float32, torch.float64)
    """
    return x.float() if x.dtype in _HALF else x
