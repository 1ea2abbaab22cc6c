"""What can be asked of a loss that rates its samples, beside its value."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import set_recurrent_mode

from torchrl_tsallis._checks import check_number, shown
from torchrl_tsallis.ratings.base import Evidence, Rated, Rating
from torchrl_tsallis.ratings.batch import Batch
from torchrl_tsallis.ratings.normal import diagonal_normal, squared_distance, surprise_of


@contextmanager
def evaluating(*modules: nn.Module) -> Iterator[None]:
    """Puts modules in evaluation mode, without gradient or exploration, and puts every mode back.

    Args:
        modules: with all of their children.

    Examples:
        >>> net = nn.Dropout()
        >>> with evaluating(net):
        ...     net.training
        False
        >>> net.training
        True
    """
    modes = {id(part): (part, part.training) for module in modules for part in module.modules()}
    try:
        for part, _ in modes.values():
            part.training = False
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC), set_recurrent_mode(True):
            yield
    finally:
        for part, mode in modes.values():
            part.training = mode


class AskedLoss:
    """Mixin of :class:`~torchrl_tsallis.TsallisBCLoss`: ratings, surprises, and what tuners and updaters read."""

    rating_module: Rating
    num_members: int | None
    _last: tuple[Tensor, Batch] | None = None

    if TYPE_CHECKING:
        actor_network: Any
        actor_network_params: Any
        training: bool

        def _rate(self, tensordict: TensorDictBase, *args: Any, **options: Any) -> tuple[Evidence, Rated]: ...

    @property
    def q(self) -> Tensor:
        """Tsallis index of the rating, a scalar, or ``[S]`` with members; setting it writes into the rating."""
        return self._q

    @q.setter
    def q(self, value: float | Tensor) -> None:
        with torch.no_grad():
            self._q.copy_(torch.as_tensor(value))

    @property
    def _q(self) -> Tensor:
        q = getattr(self.rating_module, "q", None)
        if not isinstance(q, Tensor):
            raise AttributeError(
                f"{type(self.rating_module).__name__} has no q; see the settings of loss.rating_module"
            )
        return q

    @property
    def target_members(self) -> Tensor | None:
        """Which stacked members are rated by their target network, ``[S]`` bool; None for all of them."""
        return self.rating_module.target_members

    def remember(self, evidence: Tensor, batch: Batch) -> None:
        """Keeps what the rating's tuner works on, of a batch in training mode."""
        if self.training and not torch._C._functorch.is_batchedtensor(evidence):  # would leak out of torch.vmap
            self._last = evidence, batch

    @property
    def last_evidence(self) -> tuple[Tensor, Batch]:
        """What the rating gave its tuner of the last batch in training mode, ``[*B]``, and the batch.

        Raises:
            RuntimeError: before the first ``forward``.
        """
        if self._last is None:
            raise RuntimeError("no batch was rated in training mode yet: call the loss before its tuner")
        return self._last

    def member_state_dict(self, member: int) -> dict[str, Tensor]:
        """State dict of the actor of one stacked member; ``actor.load_state_dict`` takes it.

        Args:
            member: index of the member, in the order of the actors that the loss was made of.

        Returns:
            Copies of the member's parameters, by the actor's own names.

        Raises:
            ValueError: if the loss has no stacked members.
        """
        if self.num_members is None:
            raise ValueError("the loss has one policy, not stacked members: use actor.state_dict()")
        params = self.actor_network_params.data[member].flatten_keys(".")
        return {name: value.clone() for name, value in params.items()}

    @property
    def _networks_asked(self) -> list[nn.Module]:
        """Networks whose mode decides about the answers; TorchRL keeps them out of the loss's children."""
        return [self.actor_network]

    def _ask(
        self,
        question: Callable[[Evidence, Rated], Tensor],
        tensordict: TensorDictBase,
        chunk_size: int | None,
        **options: Any,
    ) -> Tensor:
        """An answer about every sample, ``[*B]``, in evaluation mode; NaN where the mask leaves a sample out."""
        if not isinstance(tensordict, TensorDictBase):
            raise TypeError(f"tensordict must be a TensorDict of samples, got {shown(tensordict)}")
        with evaluating(self, *self._networks_asked):  # type: ignore[arg-type]
            dim = 0 if self.num_members is None else 1
            if chunk_size is None or tensordict.ndim <= dim:
                parts: Any = [tensordict]
            else:
                parts = tensordict.split(int(check_number("chunk_size", chunk_size, low=1, integer=True)), dim)
            answers = []
            for part in parts:
                evidence, rated = self._rate(part, sync=False, **options)
                answers.append(evidence.batch.valid(question(evidence, rated)))
            return answers[0] if len(answers) == 1 else torch.cat(answers, dim)

    def rating(self, tensordict: TensorDictBase, chunk_size: int | None = None) -> Tensor:
        """Rating of every sample: near 0 for what the imitator takes for noise.

        Rates in evaluation mode, with the frozen statistics of training, so that the rating of a sample does not
        depend on the others; the mode of every module is put back.

        Args:
            tensordict: samples with the keys of ``in_keys``, ``[*B]``.
            chunk_size: samples at once, along the first dimension that is not the members'. Default: None, all.

        Returns:
            The rating, ``[*B]``; NaN for samples that a mask leaves out.
        """
        return self._ask(lambda _, rated: rated.weight, tensordict, chunk_size)

    def surprise(self, tensordict: TensorDictBase, chunk_size: int | None = None) -> Tensor:
        r"""How unlikely every sample is for good data, in decades: 6 is one in a million.

        .. math:: -\log_{10} P(\chi^2_A \ge c Z)

        with the squared standardised distance Z and the share c of the variance that the rating fits. Comparable
        between data sets, units and numbers of dimensions, as far as good data is normal about the policy's mean:
        check it on samples that were held out, of which one in ten should have 1 decade or more.

        Args:
            tensordict: as for :meth:`rating`.
            chunk_size: as for :meth:`rating`.

        Returns:
            The surprise, ``[*B]``, not negative; NaN for samples that a mask leaves out.

        Raises:
            ValueError: if the actor's distribution is no diagonal normal.
            NotImplementedError: if the rating does not know its c.
        """

        def question(evidence: Evidence, _: Rated) -> Tensor:
            normal = diagonal_normal(evidence.dist, evidence.action)
            if normal is None:
                raise ValueError(f"a surprise needs a diagonal normal, the actor's is a {type(evidence.dist).__name__}")
            distance = squared_distance(normal)
            share = evidence.batch.spread(self.rating_module.variance_share.to(distance), distance)
            return surprise_of(distance, normal.loc.shape[-1], share)

        return self._ask(question, tensordict, chunk_size)
