"""What a rating is: the weight that a sample has in imitation, from the imitator's own likelihood of it."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from torchrl_tsallis.ratings.batch import Batch
from torchrl_tsallis.ratings.normal import diagonal_normal, scale_weighted_log_prob
from torchrl_tsallis.ratings.numbers import as_numbers

if TYPE_CHECKING:
    from torchrl_tsallis.ratings.tuner import RatingTuner


class Evidence(NamedTuple):
    """What a rating is given of a batch. With stacked members every shape has their dimension first, ``[S, *B]``.

    Attributes:
        log_prob: the imitator's log-density at the actions, with gradient, ``[*B]``.
        likelihood: what the policy climbs, with gradient, ``[*B]``: ``log_prob``, or its scale-weighted form where the
            rating's ``beta`` asks for that.
        dist: the imitator's distribution, batch shape ``[*B]``.
        action: the demonstrated actions, ``[*B, A]`` or ``[*B]``; a tensordict for a composite distribution.
        target_log_prob: the target network's log-density, ``[*B]``; None unless the rating ``needs_target``.
        batch: gives means over the batch, ``batch.mean(x)``.
        written: what else the loss has taken of the same pass of the network. Default: None.
    """

    log_prob: Tensor
    likelihood: Tensor
    dist: Distribution
    action: Any
    target_log_prob: Tensor | None
    batch: Batch
    written: Any = None

    def loss(self, value: Tensor, weight: Tensor) -> Tensor:
        """A loss with the given value, whose gradient is minus ``weight`` times the likelihood's.

        Args:
            value: what the loss says of each sample, ``[*B]``, without gradient.
            weight: rating of each sample, ``[*B]``, without gradient.

        Returns:
            The loss, ``[*B]``: a surrogate with an exact first derivative, and no second one.
        """
        return weighted_loss(value, weight, self.likelihood)


class Rated(NamedTuple):
    """What a rating says of a batch.

    Attributes:
        loss: of each sample, with gradient, ``[*B]``.
        weight: the rating of each sample, its gradient relative to plain behavioral cloning's, ``[*B]``.
        evidence: what the rating's tuner works on, ``[*B]``, detached.
        logged: scalars by name, or ``[S]`` with members, detached.
    """

    loss: Tensor
    weight: Tensor
    evidence: Tensor
    logged: dict[str, Tensor]


def weighted_loss(value: Tensor, weight: Tensor, likelihood: Tensor) -> Tensor:
    """A surrogate with the given value, whose gradient with respect to ``likelihood`` is minus ``weight``.

    Args:
        value: ``[*B]``, detached.
        weight: ``[*B]``, detached.
        likelihood: ``[*B]``.

    Returns:
        ``value - weight * (likelihood - likelihood.detach())``, ``[*B]``.

    Examples:
        >>> x = torch.tensor(2.0, requires_grad=True)
        >>> loss = weighted_loss(torch.tensor(7.0), torch.tensor(0.5), x)
        >>> loss.backward()
        >>> loss.item(), x.grad.item()
        (7.0, -0.5)
    """
    if not likelihood.requires_grad:
        return value
    # An action outside of the distribution's support has -inf - -inf here, and no gradient.
    change = (likelihood - likelihood.detach()).nan_to_num(0.0, 0.0, 0.0)
    return torch.addcmul(value, weight, change, value=-1)


class Rating(nn.Module):
    """Base class: subclass it, implement :meth:`forward`, and pass an instance to ``TsallisBCLoss(actor, rating=...)``.

    Settings that may differ between stacked members are declared by :meth:`add_setting`; they become buffers, scalars
    or ``[S]``, and are checkpointed with the loss.

    Args:
        beta: power of the scale-weighted likelihood, in [0, 1]; each dimension's log-density is multiplied by
            its detached ``scale^(2 beta)``. 0 is the plain likelihood. Needs a distribution with a location and scale,
            as :func:`~torchrl_tsallis.ratings.normal.diagonal_normal` finds them.

    Examples:
        >>> class Threshold(Rating):  # takes no sample whose density is under 1
        ...     def forward(self, evidence):
        ...         value = -evidence.log_prob.detach()
        ...         weight = (value < 0).to(value)
        ...         return Rated(evidence.loss(value, weight), weight, value, {})
        >>> Threshold().needs_target
        False
    """

    #: What ``run.json`` calls the class. Default: its module and name.
    saved_as: ClassVar[str] = ""
    #: The classes by that, of modules that were imported.
    known: ClassVar[dict[str, type[Rating]]] = {}
    #: Whether the target network's log-density is needed.
    needs_target: bool = False
    #: Names of what ``forward`` logs, in the order in which the loss returns them.
    logged: tuple[str, ...] = ()

    beta: Tensor

    def __init_subclass__(cls, **options: Any) -> None:
        """Makes the class known to runs that are opened.

        Raises:
            TypeError: if another class is saved by the same name.
        """
        super().__init_subclass__(**options)
        own = f"{cls.__module__}.{cls.__qualname__}"
        cls.saved_as = cls.__dict__.get("saved_as") or own
        there = Rating.known.setdefault(cls.saved_as, cls)
        if f"{there.__module__}.{there.__qualname__}" != own:
            raise TypeError(
                f"{own} is saved as {cls.saved_as!r}, as {there.__module__}.{there.__qualname__} is: rename it"
            )
        Rating.known[cls.saved_as] = cls  # a class that is defined again, as in a notebook

    @classmethod
    def settings_of(cls, state: Mapping[str, Tensor]) -> dict[str, Any]:
        """Settings of a rating of one policy by its state, as ``run.json`` says them and :meth:`from_settings` reads.

        Default: the constructor's arguments that are scalars of the state.

        Examples:
            >>> from torchrl_tsallis import PeakRating
            >>> PeakRating.settings_of(PeakRating(u=0.25).state_dict())
            {'u': 0.25, 'beta': 0.5}
        """
        names = [name for name in inspect.signature(cls).parameters if name in state and state[name].ndim == 0]
        return {name: float(state[name]) for name in names}

    @classmethod
    def from_settings(cls, settings: Mapping[str, Any]) -> Rating:
        """A rating with such settings, whose running statistics are at their start."""
        return cls(**settings)

    def __init__(self, beta: float | Sequence[float] = 0.0) -> None:
        super().__init__()
        self._settings: dict[str, str] = {}  # buffer: what the user calls it
        self.add_setting("beta", beta, 0, 1)
        #: Whether any member has a scale-weighted likelihood.
        self.scale_weighted = bool((self.beta > 0).any())

    def add_setting(self, name: str, value: Any, low: float, high: float, *, argument: str | None = None) -> None:
        """Registers a number in [low, high], or one for each stacked member, as a buffer.

        Args:
            name: of the setting and its buffer.
            value: a number, or a sequence of them.
            low: the least that is allowed.
            high: the largest that is allowed.
            argument: what messages call it. Default: ``name``.

        Raises:
            ValueError: for anything else; the message names the setting.
        """
        argument = argument or name
        self.register_buffer(name, torch.tensor(as_numbers(argument, value, low, high), dtype=torch.float32))
        self._settings[name] = argument

    def stack(self, num_members: int | None) -> None:
        """Gives every setting the shape ``[S]`` of stacked members, or checks that there are none.

        Args:
            num_members: S; None for a single policy.

        Raises:
            ValueError: if a setting was given for another number of policies.
        """
        for name, argument in self._settings.items():
            value = getattr(self, name)
            if value.ndim and len(value) != num_members:
                raise ValueError(
                    f"{argument} has {len(value)} values for {num_members or 1} policies: give a number or one of "
                    "each, and each loss a rating of its own"
                )
            if num_members is not None and not value.ndim:
                setattr(self, name, value.repeat(num_members))

    def likelihood(self, log_prob: Tensor, dist: Distribution, action: Any, batch: Batch) -> Tensor:
        """What the policy climbs: the log-density, or its scale-weighted form where ``beta`` asks for that.

        Args:
            log_prob: ``[*B]``, with gradient.
            dist: the imitator's distribution.
            action: ``[*B, A]``.
            batch: whose samples they are.

        Returns:
            The likelihood, ``[*B]``, with gradient.

        Raises:
            ValueError: if beta > 0 and the distribution is no diagonal normal.
        """
        if not self.scale_weighted:
            return log_prob
        normal = diagonal_normal(dist, action)
        if normal is None:
            raise ValueError(
                f"beta > 0 needs a distribution with location and scale, the actor's is a {type(dist).__name__}: "
                "give the rating beta=0"
            )
        return scale_weighted_log_prob(normal, batch.spread(self.beta.to(normal.loc), normal.loc))

    @property
    def target_members(self) -> Tensor | None:
        """Which stacked members are rated by their target network, ``[S]`` bool; None for all of them."""
        return None

    @property
    def variance_share(self) -> Tensor:
        """Fitted variance as a share of the true one where the data is normal, a scalar or ``[S]``.

        Raises:
            NotImplementedError: if it is not known for this rating.
        """
        raise NotImplementedError(f"how {type(self).__name__} changes the fitted scale is not known")

    def tuner(self) -> type[RatingTuner]:
        """The class that tunes this rating.

        Raises:
            NotImplementedError: if nothing does.
        """
        raise NotImplementedError(f"nothing tunes {type(self).__name__}: its settings are fixed")

    def forward(self, evidence: Evidence) -> Rated:
        """Rates a batch.

        Args:
            evidence: of the batch.

        Returns:
            Loss and rating of each sample, and what is logged.
        """
        raise NotImplementedError
