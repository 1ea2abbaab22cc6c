"""Whether parameters were replaced by others, as no step of an optimizer does."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from torch import Tensor, nn

from torchrl_tsallis.optim.segments import Segments

_RELATED = 0.3  # least correlation of a tensor with what it was


def replaced_members(segments: Segments, new: Sequence[Tensor], old: Sequence[Tensor]) -> Tensor:
    r"""Members whose parameters have nothing to do with their target any more.

    Steps of an optimizer leave parameters that resemble what they were, while two trained networks are no more alike
    than random numbers. With x and y the new and old entries of a tensor about their means, the correlation
    ``2 E[x y] / (E[x^2] + E[y^2])`` is near 1 in the first case and near 0 in the second. A member is replaced
    where it is under 0.3 for at least half of all entries. Tensors of equal entries, such as biases of zero and
    weights of a new normalisation layer, do not count.

    Args:
        segments: layout of the tensors.
        new: the parameters, ``[*B, *E]`` each.
        old: what they were, of the same shapes.

    Returns:
        ``[prod(B)]`` bool.

    Examples:
        >>> import torch
        >>> old = [torch.linspace(-1.0, 1.0, 50)]
        >>> replaced_members(Segments(old), [old[0] + 1.0], old), replaced_members(Segments(old), [old[0].sin()], old)
        (tensor([False]), tensor([False]))
        >>> replaced_members(Segments(old), [(9 * old[0]).cos()], old)
        tensor([True])
    """
    x, y = segments.flatten([p.detach() for p in new]), segments.flatten(old)
    x, y = x - segments.expand(segments.mean(x)), y - segments.expand(segments.mean(y))
    spread = segments.mean(y.square())
    # NaN compares as False: parameters that diverged were not replaced.
    unrelated = 2 * segments.mean(x * y) < _RELATED * (segments.mean(x.square()) + spread)
    entries = segments.reciprocals.reciprocal() * (spread > 0)  # in the order [tensor, member]
    lost, entries = (n.view(len(segments.sizes), -1).sum(0) for n in (entries * unrelated, entries))
    return (entries > 0) & (2 * lost >= entries)


class _Hook:
    """Calls a method of an object that may be gone, and that no copy or file of the hooked module takes along."""

    def __init__(self, owner: Any = None, name: str = "") -> None:
        self.owner, self.name = (lambda: None) if owner is None else weakref.ref(owner), name

    def __call__(self, *args: Any) -> None:
        owner = self.owner()
        if owner is not None:
            getattr(owner, self.name)(*args)

    def __reduce__(self) -> tuple[Any, ...]:
        return _Hook, ()


class LoadWatch:
    """Tells when ``load_state_dict`` is about to change modules, and when it has; for whole modules and parts of them.

    Args:
        modules: those to watch, with all of their parts.
        before: called with the state dict and its prefix, before anything is loaded.
        after: called with the module that was loaded, after all of it was.
    """

    def __init__(
        self, modules: Iterable[nn.Module], before: Callable[[dict[str, Any], str], None], after: Callable[[Any], None]
    ) -> None:
        self.before, self.after = before, after
        self.outermost: int | None = None
        handles = []
        for part in {id(part): part for module in modules for part in module.modules()}.values():
            handles.append(part.register_load_state_dict_pre_hook(_Hook(self, "_before")))
            handles.append(part.register_load_state_dict_post_hook(_Hook(self, "_after")))
        weakref.finalize(self, _remove, handles).atexit = False

    def _before(self, module: nn.Module, state_dict: dict[str, Any], prefix: str, *_: Any) -> None:
        if self.outermost is None or not prefix:
            self.outermost = id(module)
            self.before(state_dict, prefix)

    def _after(self, module: nn.Module, _: Any) -> None:
        if id(module) == self.outermost:
            self.outermost = None
            self.after(module)


def _remove(handles: list[Any]) -> None:
    for handle in handles:
        handle.remove()
