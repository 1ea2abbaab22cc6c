"""Any imitation loss of TorchRL whose samples are rated by their own loss: no density is needed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives.common import LossModule

from torchrl_tsallis._checks import check_choice, check_flag, check_number, shown
from torchrl_tsallis.objectives.actor import named_inputs
from torchrl_tsallis.objectives.asking import AskedLoss
from torchrl_tsallis.objectives.inputs import check_key, mask_of
from torchrl_tsallis.objectives.samples import (
    action_dims,
    losses_of_samples,
    means_of_others,
    plain_inputs,
    split_far,
)
from torchrl_tsallis.objectives.wrapped import WrappedLoss
from torchrl_tsallis.ratings.base import Evidence, Rated
from torchrl_tsallis.ratings.batch import Batch, rating_statistics
from torchrl_tsallis.ratings.normal import MAX_DISTANCE
from torchrl_tsallis.ratings.peak import PeakRating, peak_value, stretch
from torchrl_tsallis.ratings.running import RunningScale

_STATISTICS = ("rating_mean", "rating_var", "ess")


class RatedLoss(WrappedLoss, AskedLoss, LossModule):
    r"""Rates every sample of another loss by that loss, relative to a robust running scale.

    .. math::
        Z_i = \frac{A \, \ell_i}{m}, \qquad \rho_i = e^{-u Z_i / 2}, \qquad
        m \leftarrow m + \kappa \left(\frac{\sum_i \rho_i \ell_i}{\sum_i \rho_i} - m\right), \qquad
        \nabla_\theta L = \mathbb{E}\left[\rho_i \nabla_\theta \ell_i\right]

    :math:`\ell_i` is the wrapped loss of sample i, the mean over what dimensions it has beside those of the batch. For
    a squared error, :math:`\ell_i = |a_i - \mu_i|^2 / A`, this is :class:`~torchrl_tsallis.PeakRating` of a normal with
    one scale, :math:`s^2 = m`: Z is the squared distance in such scales. Whether a loss is a sum or a mean over the
    dimensions, and what unit it has, cancels in Z; the number A does not: a typical good sample has Z of about A. The
    value of the loss is :math:`2 m (1 - \rho_i) / (u A)`, which is :math:`\ell_i` for u = 0 and has its unit.

    Used as :class:`~torchrl_tsallis.TsallisBCLoss` is, by :class:`~torchrl_tsallis.ScoreTuner` and
    :func:`~torchrl_tsallis.trainers.make_offline_trainer` too. Parameters are those of the wrapped loss. In training
    the scale is the one before the batch; in ``eval()`` it is frozen.

    Reads what the wrapped loss does, and writes the keys below; all but the loss are detached scalars.

    ==================  =========================================================================
    the loss's own key  the loss, a scalar, or ``[*B]`` with ``reduction="none"``
    ``u``               the rejection
    ``distance``        typical Z / A, see :class:`~torchrl_tsallis.PeakRating`
    ``rating_mean``     mean of the rating
    ``rating_var``      (biased) variance of the rating
    ``ess``             effective sample size of the batch under the rating, in samples
    other keys          means of the wrapped loss's other outputs, without ``loss_`` in their names
    ==================  =========================================================================

    ======  ========  =======  ===============================================
    symbol  argument  default  source
    ======  ========  =======  ===============================================
    u       rating    0.2      start value where it is tuned; measured
    A       dims      None     the dimensions that the loss is a mean over
    kappa   rate      0.02     measured
    ======  ========  =======  ===============================================

    **Limits.** The score that tunes u takes a good sample's loss for the squared length of A normal errors. Where a
    loss varies more than that by itself, as denoising losses do over their random time steps, the tuner takes this for
    outliers, and ``draws`` helps in part; ``docs/any_loss.md`` has measurements. A loss that can be negative, as a
    log-density's, is refused: rate that by :class:`~torchrl_tsallis.TsallisBCLoss`.

    Source: this project.

    Args:
        loss_module: a loss of TorchRL made with ``reduction="none"``, such as ``BCLoss`` with a deterministic actor,
            ``DiffusionBCLoss`` or ``ACTLoss``.

    Keyword Args:
        rating (PeakRating): for this loss alone; its beta does nothing, because there is one scale. Default: None, a
            ``PeakRating()``.
        loss_key (NestedKey): the output that is minimised. Default: None, the only one that starts with ``"loss"``.
        dims (float): A. Default: None, the number of elements that the loss has a sample, or if it has one, that the
            action (chunk) has; times ``draws``.
        rate (float): kappa, in (0, 1]. Default: 0.02.
        draws (int): for a loss that draws random numbers: rates by the mean loss of so many more passes, without
            gradient, so that a sample's rating is not that of its luck. Default: 0, rates by the pass with gradient.
        reduction (str): ``"mean"``, ``"sum"`` or ``"none"`` of the samples. Default: ``"mean"``.
        sync_stats (bool): take the statistics of the batch over all processes of ``torch.distributed``. Default: True.
        process_group (ProcessGroup): these processes only. Default: None, all of them.

    Raises:
        TypeError: if something is no loss or no PeakRating.
        ValueError: if the loss is reduced already, has several outputs to minimise or negative values; or a setting is
            outside of its range.
        KeyError: in ``forward``, for a missing key.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from torch import nn
        >>> from torchrl.objectives import BCLoss
        >>> actor = TensorDictModule(nn.Linear(3, 2), in_keys=["observation"], out_keys=["action"])
        >>> loss = RatedLoss(BCLoss(actor, loss_function="l2", reduction="none"))
        >>> data = TensorDict({"observation": torch.randn(5, 3), "action": torch.zeros(5, 2)}, [5])
        >>> sorted(loss(data).keys())
        ['distance', 'ess', 'loss_bc', 'rating_mean', 'rating_var', 'u']
        >>> loss.rating(data).shape
        torch.Size([5])
    """

    num_members = None
    loss_module: LossModule
    rating_module: PeakRating
    scale: RunningScale

    def __init__(
        self,
        loss_module: LossModule,
        *,
        rating: PeakRating | None = None,
        loss_key: str | None = None,
        dims: float | None = None,
        rate: float = 0.02,
        draws: int = 0,
        reduction: Literal["mean", "sum", "none"] | None = None,
        sync_stats: bool = True,
        process_group: Any = None,
    ) -> None:
        super().__init__()
        kind = type(loss_module).__name__
        if not isinstance(loss_module, LossModule):
            raise TypeError(f"loss_module must be a loss of TorchRL, got {kind}: for instance BCLoss(actor)")
        if hasattr(loss_module, "rating_module"):
            raise ValueError(f"{kind} rates its samples already: use it as it is")
        found = getattr(loss_module, "reduction", None)
        if found != "none":
            raise ValueError(
                f"the loss of each sample is needed, {kind} has reduction={found!r}: make it by "
                f"{kind}(..., reduction='none')"
            )
        if not isinstance(rating, PeakRating | None):
            raise TypeError(f"RatedLoss takes a PeakRating as rating, got {shown(rating)}")
        if reduction is not None:
            check_choice("reduction", reduction, ("mean", "sum", "none"))
        self.loss_module = loss_module
        self.rating_module = PeakRating() if rating is None else rating
        self.rating_module.stack(None)
        self.scale = RunningScale(check_number("rate", rate, above=0, high=1))
        self.dims = None if dims is None else check_number("dims", dims, above=0)
        self.draws = int(check_number("draws", draws, low=0, integer=True))
        self.reduction = reduction or "mean"
        self.sync_stats = check_flag("sync_stats", sync_stats)
        self.process_group = process_group
        check_key("loss_key", loss_key)
        self.loss_key = self._only_loss() if loss_key is None else loss_key
        others = [self._name(key) for key in loss_module.out_keys if key != self.loss_key]
        self.out_keys = [self.loss_key, *self.rating_module.logged, *_STATISTICS, *others]

    def _only_loss(self) -> str:
        losses = [key for key in self.loss_module.out_keys if isinstance(key, str) and key.startswith("loss")]
        if len(losses) != 1:
            raise ValueError(
                f"{type(self.loss_module).__name__} returns {losses or list(self.loss_module.out_keys)}: say by "
                "loss_key= which of them is minimised"
            )
        return losses[0]

    @staticmethod
    def _name(key: NestedKey) -> NestedKey:
        """What a further output is called: nothing but the loss itself may be summed up by a trainer."""
        return key.removeprefix("loss_") if isinstance(key, str) else key

    def train(self, mode: bool = True) -> RatedLoss:
        """Sets the networks' mode too, as :class:`~torchrl_tsallis.TsallisBCLoss` does."""
        super().train(mode)
        if "loss_module" in self._modules:
            for network in self._networks_asked:
                network.train(mode)
        return self

    def batch_of(self, mask: Tensor | None, sync: bool = True) -> Batch:
        """What a mean over a batch with a mask ``[*B]`` means: of all processes if ``sync``."""
        return Batch.of(mask, False, sync and self.sync_stats, self.process_group)

    def _rate(self, tensordict: TensorDictBase, sync: bool = True, draws: int | None = None) -> tuple[Evidence, Rated]:
        """Rates a batch, by the pass that has the gradient or by the mean of some that have none."""
        inputs = plain_inputs(tensordict, self.loss_module, self._networks_asked)
        batch = self.batch_of(mask_of(self, inputs), sync)
        inputs, far = split_far(inputs, self.in_keys, batch.mask)

        def draw() -> tuple[Tensor, int, TensorDictBase]:
            with named_inputs(self.loss_module, inputs):
                written = self.loss_module(inputs.copy())
            losses, elements = losses_of_samples(written, self.loss_key, inputs.shape, batch.mask)
            return losses.masked_fill(far, torch.inf), elements, written

        losses, elements, written = draw()
        dims = self.dims or (elements if elements > 1 else action_dims(self.loss_module, inputs)) * max(self.draws, 1)
        with torch.no_grad():
            passes = self.draws if draws is None else draws
            known = torch.stack([draw()[0] for _ in range(passes)]).mean(0) if passes else losses.detach()
            known = known if batch.mask is None else known.where(batch.mask, 0.0)
            scale = self.scale(known, batch)
            distance = (known * (dims / scale)).clamp(max=MAX_DISTANCE)
            distance, typical = self.rating_module.calibrated(distance, dims, batch)
            value, weight = peak_value(distance, self.rating_module.u.to(distance))
            value = value * (2 * scale * stretch(typical) / dims)  # in the unit of the loss
            self.scale.update(known, weight, batch)
        none: Any = None
        evidence = Evidence(-losses, -losses, none, inputs, None, batch, written)
        logged = {"u": self.rating_module.u.clone(), "distance": typical}
        return evidence, Rated(evidence.loss(value, weight), weight, distance, logged)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the loss and its statistics.

        Args:
            tensordict: demonstrations with the keys of ``in_keys``, ``[*B]``: what is rated is one element of its batch
                size, or of the first dimension if it has none. A mask under ``loss_mask_key`` selects.

        Returns:
            A tensordict with the keys of ``out_keys``.
        """
        evidence, rated = self._rate(tensordict)
        batch = evidence.batch
        if self.reduction == "none":
            loss = rated.loss if batch.mask is None else rated.loss.where(batch.mask, 0.0)
        else:
            loss = batch.share_of_mean(rated.loss) if self.reduction == "mean" else batch.sum(rated.loss)
        self.remember(rated.evidence, batch)
        out = {self.loss_key: loss}
        with torch.no_grad():
            out |= (
                rated.logged
                | rating_statistics(rated.weight, batch)
                | means_of_others(evidence, self.loss_key, self._name)
            )
        return TensorDict(out, [])

    def rating(
        self, tensordict: TensorDictBase, chunk_size: int | None = None, *, draws: int | None = None, seed: int = 0
    ) -> Tensor:
        """Rating of every sample: near 0 for what the imitator takes for noise.

        In evaluation mode, with the frozen statistics of training, as :meth:`TsallisBCLoss.rating`.

        Args:
            tensordict: samples with the keys of ``in_keys``, ``[*B]``.
            chunk_size: samples at once, along the first dimension. Default: None, all.
            draws: by the mean loss of how many passes samples are rated. Default: None, as in training.
            seed: of the loss's random numbers, which also depend on the chunks. The state of torch's generators is put
                back.

        Returns:
            The rating, ``[*B]``; NaN for samples that a mask leaves out.
        """
        draws = self.draws if draws is None else int(check_number("draws", draws, low=0, integer=True))
        with _seeded(seed, [p.device for p in self.parameters()]):
            return self._ask(lambda _, rated: rated.weight, tensordict, chunk_size, draws=draws)

    def surprise(self, tensordict: TensorDictBase, chunk_size: int | None = None) -> Tensor:
        """There is none without a density.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError("a surprise needs the actor's distribution: use rating(), or TsallisBCLoss")


@contextmanager
def _seeded(seed: int, devices: list[torch.device]) -> Iterator[None]:
    """Random numbers from a seed, whose state is put back."""
    with torch.random.fork_rng(sorted({d.index or 0 for d in devices if d.type == "cuda"})):
        torch.manual_seed(check_number("seed", seed, integer=True))
        yield
