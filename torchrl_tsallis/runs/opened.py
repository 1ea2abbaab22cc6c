"""A run that was saved: a policy that can act and rate, with the scaling of its data."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.modules import IndependentNormal, ProbabilisticActor

from torchrl_tsallis.data.robust_scaling import RobustScaling
from torchrl_tsallis.modules.policy import make_policy
from torchrl_tsallis.objectives.bc import TsallisBCLoss
from torchrl_tsallis.ratings.peak import PeakRating
from torchrl_tsallis.runs.folder import FORMAT, RUN, read_csv, read_json
from torchrl_tsallis.runs.policies import ScaledMeanPolicy, ScaledNetwork
from torchrl_tsallis.runs.source import Source, load_source


class Run:
    """The folder of a run, opened: its policy, its rating, its scaling, and its tables.

    Everything is read when it is asked for, and nothing in the folder is run as code.

    Args:
        folder: of the run.

    Raises:
        FileNotFoundError: if it is no run.
        ValueError: if a file is broken, or of another format.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder).expanduser()
        self.settings = read_json(self.folder / RUN)
        if self.settings.get("format") != FORMAT:
            raise ValueError(
                f"{str(self.folder)!r} has the format {self.settings.get('format')!r}, this version reads {FORMAT}: "
                "make the run again"
            )
        self._loss: TsallisBCLoss | None = None

    @classmethod
    def open(cls, folder: str | os.PathLike[str]) -> Run:
        """Opens a run; the same as the constructor."""
        return cls(folder)

    def __repr__(self) -> str:
        """Folder and kind."""
        return f"Run({str(self.folder)!r}, kind={self.settings.get('kind')!r})"

    def _tensors(self, name: str) -> dict[str, Tensor]:
        path = self.folder / name
        if not path.is_file():
            raise FileNotFoundError(f"{str(path)!r} is not there: the run is not complete, make it again")
        try:
            return load_file(path)
        except SafetensorError as error:
            raise ValueError(f"{str(path)!r} is broken ({error}): make the run again") from error

    def _policy(self) -> ProbabilisticActor:
        """The actor of scaled observations and actions."""
        policy = self.settings.get("policy", {})
        if policy.get("factory") != "torchrl_tsallis.modules.make_policy":
            raise ValueError(f"{str(self.folder)!r} has a policy of {policy.get('factory')!r}, which is not known here")
        actor = make_policy(**policy["arguments"])
        try:
            actor.load_state_dict(self._tensors("policy.safetensors"))
        except RuntimeError as error:
            raise ValueError(
                f"{str(self.folder / 'policy.safetensors')!r} is no state of the policy that {RUN} describes: make the "
                "run again"
            ) from error
        return actor.eval()

    @property
    def scaling(self) -> RobustScaling:
        """Centres and scales of the policy's training data."""
        return RobustScaling.from_json(read_json(self.folder / "scaling.json"))

    def network(self) -> ScaledNetwork:
        """The network from an observation to mean and scale of the action, in the units of the data."""
        return ScaledNetwork(self._policy().module[0].module, self.scaling).eval()

    def actor(self) -> ProbabilisticActor:
        """TorchRL's actor that reads and gives the units of the data; its density is in these too.

        Examples:
            ``actor = Run.open("door").actor(); env.rollout(100, actor)``
        """
        return ProbabilisticActor(
            TensorDictModule(self.network(), in_keys=["observation"], out_keys=["loc", "scale"]),
            in_keys=["loc", "scale"],
            out_keys=["action"],
            distribution_class=IndependentNormal,
        ).eval()

    def numpy_policy(self) -> ScaledMeanPolicy:
        """The mean action without torch, in the units of the data."""
        return ScaledMeanPolicy.of(self._tensors("policy.safetensors"), self.scaling)

    def loss(self) -> TsallisBCLoss:
        """The loss that the policy was trained by, of scaled data, with its rating as it was in the end."""
        if self._loss is None:
            loss = TsallisBCLoss(self._policy(), rating=PeakRating(beta=self.settings["method"]["beta"]))
            try:
                loss.rating_module.load_state_dict(self._tensors("rating.safetensors"))
            except RuntimeError as error:
                raise ValueError(
                    f"{str(self.folder / 'rating.safetensors')!r} is no state of the rating: make the run again"
                ) from error
            self._loss = loss.eval()
        return self._loss

    def read(self, data: str | os.PathLike[str] | TensorDictBase) -> Source:
        """Reads data by the keys of the run's own.

        Raises:
            ValueError: if its dimensions are others.
        """
        keys = self.settings["data"]["keys"]
        stored = self.settings["data"]["format"] != "memory" and not isinstance(data, TensorDictBase)
        action = keys["action"] if len(keys["action"]) > 1 else keys["action"][0]
        source = load_source(data, obs=keys["observation"], action=action) if stored else load_source(data)
        arguments = self.settings["policy"]["arguments"]
        wanted = (arguments["obs_dim"], arguments["action_dim"])
        if source.dims != wanted:
            raise ValueError(
                f"observation and action have {source.dims} dimensions, the run's {wanted}: give data of its kind"
            )
        return source

    def _ask(self, name: str, data: Any, chunk_size: int) -> Tensor:
        rows, scaling, loss = self.read(data).data, self.scaling, self.loss()
        question = getattr(loss, name)
        parts = [
            question(scaling(rows[start : start + chunk_size].select("observation", "action").clone()))
            for start in range(0, len(rows), chunk_size)
        ]
        return torch.cat(parts)

    def rate(self, data: str | os.PathLike[str] | TensorDictBase, *, chunk_size: int = 4096) -> Tensor:
        """Rating of every row by the saved policy, ``[N]``: near 0 for what it takes for noise.

        Args:
            data: file or folder, whose keys are those of the run's own data, or a tensordict ``[N]``.
            chunk_size: rows at once.
        """
        return self._ask("rating", data, chunk_size)

    def surprise(self, data: str | os.PathLike[str] | TensorDictBase, *, chunk_size: int = 4096) -> Tensor:
        """Surprise of every row by the saved policy, ``[N]``, in decades; see ``TsallisBCLoss.surprise``.

        The policy has seen its training data, so that there these are smaller than the held-out ones of the tables.

        Args:
            data: as for :meth:`rate`.
            chunk_size: rows at once.
        """
        return self._ask("surprise", data, chunk_size)

    @property
    def summary(self) -> dict[str, Any]:
        """``summary.json``: whether the ratings are usable, and the verdict."""
        return read_json(self.folder / "summary.json")

    @property
    def episodes(self) -> list[dict[str, str]]:
        """``episodes.csv``: one dictionary an episode, in the order of the data."""
        return read_csv(self.folder / "episodes.csv")

    @property
    def ratings(self) -> list[dict[str, str]]:
        """``ratings.csv``: one dictionary a row."""
        return read_csv(self.folder / "ratings.csv")
