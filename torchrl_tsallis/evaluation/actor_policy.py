"""An actor of TorchRL as a deterministic policy from arrays to arrays."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import set_recurrent_mode

from torchrl_tsallis._checks import check_instance
from torchrl_tsallis.modules.settings import check_key

Key = tuple[str, ...]
_DEFAULT = "let the module start from zeros where it finds none, as TorchRL's LSTMModule does"


def _tuple(key: NestedKey) -> Key:
    return (key,) if isinstance(key, str) else tuple(key)


def _names(keys: list[Key]) -> str:
    return ", ".join(repr(key[0] if len(key) == 1 else key) for key in keys) or "none"


class ActorPolicy:
    """An actor as :func:`~torchrl_tsallis.evaluation.evaluate_policies` runs it: its most likely action, no gradient.

    Exploration is deterministic, whatever the caller's setting. An input that the actor also writes, under ``next`` or
    in place, is its recurrent state: it is carried from step to step, and left out at an episode's first one, where
    ``is_init`` is true. The actor's mode is not touched here; what runs the policy sets it to evaluation, and back.

    Observations must be in the units that the actor was trained on: a
    :class:`~torchrl_tsallis.data.Scaling` is not part of it (see
    :class:`~torchrl_tsallis.evaluation.RecurrentMeanPolicy`).

    Args:
        actor: ``TensorDictModule``, ``ProbabilisticActor`` or the like.
        observation_key: of the observation, if that is one array. Default: the only input that is no state. Of a Dict
            observation each entry goes to the input of its name.
        action_key: of the action. Default: ``"action"``, the distribution's sample, or the only output.

    Raises:
        ValueError: if a default key is not unique; the message names the candidates.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> actor = TensorDictModule(torch.nn.Identity(), in_keys=["observation"], out_keys=["action"])
        >>> ActorPolicy(actor)(np.array([1.0, 2.0]))
        array([1., 2.], dtype=float32)
    """

    def __init__(
        self,
        actor: TensorDictModuleBase,
        *,
        observation_key: NestedKey | None = None,
        action_key: NestedKey | None = None,
    ) -> None:
        check_instance("actor", actor, TensorDictModuleBase, "a TensorDictModule, such as make_policy's actor")
        for name, key in (("observation_key", observation_key), ("action_key", action_key)):
            if key is not None:
                check_key(name, key)
        inputs, outputs = ([_tuple(key) for key in keys] for keys in (actor.in_keys, actor.out_keys))
        self.actor = actor
        self.states = {key: ("next", *key) for key in inputs if ("next", *key) in outputs}
        self.states |= {key: key for key in inputs if key in outputs and key not in self.states}
        self.inputs = [key for key in inputs if key not in self.states and key[-1] != "is_init"]
        self.is_init = [key for key in inputs if key[-1] == "is_init"]
        if observation_key is not None:
            self.inputs = [_tuple(observation_key)]
        self.action_key = _action_key(actor, outputs) if action_key is None else _tuple(action_key)
        self._stateless = f"the actor has no initial value for its state {_names(list(self.states))}"
        self.reset()

    def reset(self) -> None:
        """Forgets: the next call is the first of an episode."""
        self._state: dict[Key, Tensor] = {}
        self._begun = False

    def __deepcopy__(self, memo: dict[int, Any]) -> ActorPolicy:
        """A policy with a memory of its own; it shares the actor, unless that has a memory too."""
        own = copy.copy(self)
        if any(hasattr(module, "reset") for module in self.actor.modules()):
            own.actor = copy.deepcopy(self.actor, memo)
        own._state = dict(self._state)
        return own

    def __call__(self, observation: Any) -> np.ndarray:
        """Maps an observation ``[*O]``, or a mapping of several, to the action ``[*A]``, and remembers."""
        given = self._batch_of_one(observation)
        try:
            with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC), set_recurrent_mode(False):
                written = self.actor(given)
        except (KeyError, TypeError, AttributeError) as error:  # what modules raise where None stands for a tensor
            if self._begun or not self.states:
                raise
            raise ValueError(f"{self._stateless}, its first step fails ({error}): {_DEFAULT}") from error
        except RuntimeError as error:
            given_shapes = {key: tuple(given[key].shape[1:]) for key in self.inputs}
            raise ValueError(
                f"the actor cannot take observations of shape {given_shapes} ({error}): was it trained in this "
                "environment?"
            ) from error
        self._state = {key: written.get(source) for key, source in self.states.items()}
        if not all(isinstance(state, (Tensor, TensorDictBase)) for state in self._state.values()):
            raise ValueError(f"{self._stateless}, and writes none: {_DEFAULT}")
        self._begun = True
        action = written.get(self.action_key)[0].detach().cpu()
        return (action.float() if action.dtype == torch.bfloat16 else action).numpy()

    def _batch_of_one(self, observation: Any) -> TensorDictBase:
        """The actor's inputs for one step, of batch size 1: some networks need a batch."""
        tensors = list(self.actor.parameters())
        device = tensors[0].device if tensors else None
        dtype = next((t.dtype for t in tensors if t.is_floating_point()), torch.get_default_dtype())
        given = TensorDict({}, [1], device=device)
        for key, value in self._entries(observation).items():
            tensor = torch.from_numpy(np.array(value))
            given.set(key, (tensor.to(dtype) if tensor.is_floating_point() else tensor)[None])
        for key in self.is_init:
            given.set(key, torch.full((1, 1), not self._begun))
        for key, state in self._state.items():
            given.set(key, state)
        return given

    def _entries(self, observation: Any) -> dict[Key, Any]:
        """What of the observation goes to which input."""
        if not isinstance(observation, Mapping):
            if len(self.inputs) != 1:
                raise ValueError(
                    f"the actor reads {_names(self.inputs)}, the environment gives one observation: name its key, "
                    "ActorPolicy(actor, observation_key=...)"
                )
            return {self.inputs[0]: observation}
        entries = {}
        for key in self.inputs:
            value: Any = observation
            for part in key:
                value = value.get(part) if isinstance(value, Mapping) else None
            if value is None:
                raise ValueError(
                    f"the actor reads {_names(self.inputs)}, the observation has {sorted(map(str, observation))}: "
                    f"rename the actor's in_keys, or {key[-1]!r} in the environment"
                )
            entries[key] = value
        return entries


def _action_key(actor: TensorDictModuleBase, outputs: list[Key]) -> Key:
    """The key of the action, where it is clear."""
    named = [key for key in outputs if key[-1] == "action"]
    last = list(actor.module)[-1] if isinstance(getattr(actor, "module", None), torch.nn.ModuleList) else actor
    sampled = [_tuple(key) for key in last.out_keys] if isinstance(last, ProbabilisticTensorDictModule) else []
    sampled = [key for key in sampled if not key[-1].endswith("log_prob")]
    own = [key for key in outputs if key[0] != "next"]
    for candidates in (named, sampled, own):
        if len(candidates) == 1:
            return candidates[0]
    raise ValueError(f"which output is the action, of {_names(outputs)}? Name it: ActorPolicy(actor, action_key=...)")
