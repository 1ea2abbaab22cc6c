"""What runs a policy owns its mode and its memory, and leaves both, and the random numbers, as they were."""

from __future__ import annotations

import copy
import functools
import inspect
import random
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torchrl_tsallis.evaluation.actor_policy import ActorPolicy
from torchrl_tsallis.evaluation.mean_policy import MeanPolicy

Policy = Callable[[Any], Any]
_DEPTH = 4  # references followed from a policy, such as partial -> method -> object -> network
_WIDTH = 1000  # entries looked at of a container: a policy may hold its data
_EMPTY = types.CellType()  # of a variable that is not assigned yet


def as_policy(name: str, given: Any) -> Policy:
    """Makes a policy of what a user has.

    Args:
        name: for the message.
        given: a callable; an actor of TorchRL; or an actor's state.

    Returns:
        The callable itself, an :class:`ActorPolicy`, or a :class:`MeanPolicy`.

    Raises:
        TypeError: if it is none of them; the message names the policy.
        ValueError, KeyError: if an actor's keys or a state do not fit; likewise.

    Examples:
        >>> as_policy("mine", 3)
        Traceback (most recent call last):
        ...
        TypeError: policy 'mine' is an int: needed is a callable, observation -> action, an actor, or its state_dict
    """
    try:
        bare = getattr(given, "_orig_mod", given) if isinstance(given, nn.Module) else given  # of torch.compile
        if isinstance(bare, TensorDictModuleBase):
            return ActorPolicy(bare)
        if callable(given) and not isinstance(given, type):
            return given
        if isinstance(given, Mapping):
            return MeanPolicy.from_actor_state(dict(given.items()))
    except (KeyError, ValueError) as error:
        raise type(error)(f"policy {name!r}: {error.args[0] if error.args else error}") from error
    kind = f"the class {given.__name__}" if isinstance(given, type) else f"an {type(given).__name__}"
    raise TypeError(
        f"policy {name!r} is {kind}: needed is a callable, observation -> action, an actor, or its state_dict"
    )


def own_copy(policy: Policy) -> Policy:
    """A policy for one episode alone.

    A memory is a callable with a ``reset``: the policy itself, the object whose method it is, or one that it holds. A
    policy with memory is copied, and the copy reset; any other one is returned as it is.

    Args:
        policy: that must not be changed.

    Returns:
        The policy to call in the episode.

    Raises:
        ValueError: if there is a memory that cannot be copied or reset; the message names the way out.

    Examples:
        >>> own_copy(np.tanh) is np.tanh
        True
    """
    memories = list(_memories(policy))
    if not memories:
        return policy
    way_out = "give the evaluation a class with __call__ and reset() that copy.deepcopy can copy"
    try:
        own = copy.deepcopy(policy)
    except Exception as error:
        raise ValueError(
            f"a policy with reset() is copied for each episode, which fails ({error}): {way_out}"
        ) from error
    shared = {id(memory) for memory in memories}
    for memory in _memories(own):
        kind = type(memory).__name__
        if id(memory) in shared:
            raise ValueError(f"the policy is a function that calls {kind}, whose memory all episodes share: {way_out}")
        try:
            memory.reset()
        except TypeError as error:
            raise ValueError(f"{kind}.reset() cannot begin an episode ({error}): it must take no argument") from error
    return own


def act(policy: Policy, observation: Any) -> np.ndarray:
    """Asks a policy, and gives its answer as an array of numbers.

    Raises:
        ValueError: if the answer is none; the message says what to give.

    Examples:
        >>> act(lambda observation: torch.zeros(2, requires_grad=True), np.zeros(3))
        array([0., 0.], dtype=float32)
    """
    try:
        with torch.no_grad():
            action = policy(observation)
    except (TypeError, AttributeError, RuntimeError) as error:
        if isinstance(policy, nn.Module):
            raise ValueError(
                f"the module cannot take a NumPy observation of shape {np.shape(observation)} ({error}): if it takes "
                'tensors, give the actor TensorDictModule(module, in_keys=["observation"], out_keys=["action"])'
            ) from error
        raise
    if isinstance(action, torch.Tensor):
        action = action.detach().cpu()
        action = (action.float() if action.dtype == torch.bfloat16 else action).numpy()
    try:
        array = np.asarray(action)
    except ValueError:  # lists of several lengths
        array = np.asarray(None)
    if array.dtype.kind not in "biuf":
        raise ValueError(f"the policy gave {_short(action)}, needed is an array of numbers")
    return array


@contextmanager
def left_as_found(policies: Iterable[Policy]) -> Iterator[None]:
    """Sets all networks of policies to evaluation, and puts back what that and their running changes, come what may.

    That is the modes, the global random numbers of torch, NumPy and Python, and torch's number of threads: networks
    run with one, as in a worker process, because the number of threads decides how sums are rounded.

    Args:
        policies: functions, objects, modules; networks are found where :func:`own_copy` finds memories, and in the
            variables that a function reads.
    """
    threads, modes = torch.get_num_threads(), []
    python, numpy, cpu = random.getstate(), np.random.get_state(), torch.random.get_rng_state()
    gpus = torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else []
    try:
        modes = set_evaluation(policies)
        if modes:
            torch.set_num_threads(1)
        yield
    finally:
        for module, mode in modes:
            module.training = mode
        if modes:
            torch.set_num_threads(threads)
        random.setstate(python)
        np.random.set_state(numpy)
        torch.random.set_rng_state(cpu)
        if gpus:
            torch.cuda.set_rng_state_all(gpus)


def set_evaluation(policies: Iterable[Policy]) -> list[tuple[nn.Module, bool]]:
    """Sets all networks of policies to evaluation; returns each module with the mode it had."""
    networks = [part for policy in policies for part in _reach(policy) if isinstance(part, nn.Module)]
    modules = {id(module): module for network in networks for module in network.modules()}
    modes = [(module, module.training) for module in modules.values()]
    for module, _ in modes:
        module.training = False  # not eval(), which a class may override to do more
    return modes


def _short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 80 else f"{text[:80]}..."


def _memories(policy: Any) -> Iterator[Any]:
    """The memories of a policy; what one of them holds is its own affair."""
    return _reach(policy, lambda part: callable(part) and callable(getattr(part, "reset", None)), only=True)


def _reach(policy: Any, stop: Callable[[Any], bool] = lambda _: False, only: bool = False) -> Iterator[Any]:
    """What a policy refers to, itself first; of what ``stop`` is true of, no further; with ``only``, only such."""
    level, seen = [policy], set()
    for _ in range(_DEPTH + 1):
        following: list[Any] = []
        for part in level:
            if id(part) in seen or isinstance(part, (type, types.ModuleType, types.BuiltinFunctionType)):
                continue
            seen.add(id(part))
            stopped = stop(part)
            if stopped or not only:
                yield part
            if not stopped:
                following += _parts(part)
        level = following


def _parts(thing: Any) -> list[Any]:
    """What an object holds: arguments, attributes, entries, and the variables that its code reads."""
    if isinstance(thing, functools.partial):
        return [thing.func, *thing.args, *thing.keywords.values()]
    if inspect.ismethod(thing):
        return [thing.__self__]
    if inspect.isfunction(thing):
        variables = thing.__globals__
        held = [cell.cell_contents for cell in thing.__closure__ or () if cell != _EMPTY]
        held += [*(thing.__defaults__ or ()), *(thing.__kwdefaults__ or {}).values()]
        return [*held, *(variables[name] for name in thing.__code__.co_names if name in variables)]
    if isinstance(thing, Mapping):
        return list(islice(thing.values(), _WIDTH))
    if isinstance(thing, (list, tuple)):
        return list(islice(thing, _WIDTH))
    return list(vars(thing).values()) if hasattr(thing, "__dict__") else []
