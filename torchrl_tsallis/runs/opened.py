"""A run that was saved: a policy that can act and rate, with the scaling of its data."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.modules import IndependentNormal, ProbabilisticActor

from torchrl_tsallis.data.robust_scaling import RobustScaling
from torchrl_tsallis.modules.policy import make_policy
from torchrl_tsallis.objectives.bc import TsallisBCLoss
from torchrl_tsallis.objectives.cat import CATSoftUpdate
from torchrl_tsallis.runs.folder import RUN, read_csv, read_json
from torchrl_tsallis.runs.policies import ScaledMeanPolicy, ScaledNetwork
from torchrl_tsallis.runs.saved import load_tensors, make_rating, read_scaling, read_settings
from torchrl_tsallis.runs.source import Source, load_source
from torchrl_tsallis.runs.tables import EPISODES, RATINGS


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
        self.settings = read_settings(self.folder)
        self._loss: TsallisBCLoss | None = None

    @classmethod
    def open(cls, folder: str | os.PathLike[str]) -> Run:
        """Opens a run; the same as the constructor."""
        return cls(folder)

    def __repr__(self) -> str:
        """Folder and kind."""
        return f"Run({str(self.folder)!r}, kind={self.settings.get('kind')!r})"

    def _policy(self) -> ProbabilisticActor:
        """The actor of scaled observations and actions."""
        file = self.folder / "policy.safetensors"
        state = load_tensors(file)
        try:
            actor = make_policy(**self.settings["policy"]["arguments"])
            actor.load_state_dict(state)
        except (RuntimeError, TypeError, ValueError, KeyError) as error:
            raise ValueError(
                f"{str(file)!r} is no state of the policy that {RUN} describes: make the run again"
            ) from error
        return actor.eval()

    @property
    def scaling(self) -> RobustScaling:
        """Centres and scales of the policy's training data."""
        return read_scaling(self.folder, self.settings["policy"]["arguments"])

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
        return ScaledMeanPolicy.of(self._policy().state_dict(), self.scaling)

    def loss(self) -> TsallisBCLoss:
        """The loss that the policy was trained by, of scaled data, with its rating as it was in the end."""
        if self._loss is None:
            loss = TsallisBCLoss(self._policy(), rating=make_rating(self.settings["method"]))
            file = self.folder / "rating.safetensors"
            state = load_tensors(file)
            try:
                loss.rating_module.load_state_dict(state)
                if loss.needs_target:
                    CATSoftUpdate(loss)  # TorchRL warns of a target network that no updater follows
                    file = self.folder / "target.safetensors"
                    target = TensorDict(load_tensors(file), []).unflatten_keys(".")
                    loss.target_actor_network_params.data.update_(target)
            except (RuntimeError, KeyError) as error:
                raise ValueError(
                    f"{str(file)!r} is no state of the rating that {RUN} describes: make the run again"
                ) from error
            self._loss = loss.eval()
        return self._loss

    def read(self, data: str | os.PathLike[str] | TensorDictBase) -> Source:
        """Reads data by the keys of the run's own, where it was read from a file.

        Raises:
            ValueError: if its dimensions are others.
        """
        about = self.settings["data"]
        keys = about["keys"]
        if about["format"] == "memory" or isinstance(data, TensorDictBase):
            source = load_source(data)
        else:
            action = keys["action"] if len(keys["action"]) > 1 else keys["action"][0]
            source = load_source(data, obs=keys["observation"], action=action, episode=about.get("episode"))
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

    def _table(self, name: str) -> Path:
        if self.settings["kind"] != "ratings":
            raise FileNotFoundError(
                f"{str(self.folder)!r} is the run of a policy and has no {name}: `tsallis rate` rates demonstrations"
            )
        return self.folder / name

    @property
    def summary(self) -> dict[str, Any]:
        """Whether the ratings are usable, and the verdict, from ``summary.json``."""
        file = self._table("summary.json")
        found = read_json(file)
        missing = [name for name in ("usable", "reasons", "agreement", "calibration", "sentence") if name not in found]
        if missing:
            raise ValueError(f"{str(file)!r} does not say {missing[0]!r}: make the run again")
        return found

    @property
    def episodes(self) -> list[dict[str, str]]:
        """One dictionary an episode, in the order of the data, from ``episodes.csv``."""
        return read_csv(self._table("episodes.csv"), EPISODES, self.settings["data"].get("episodes"))

    @property
    def ratings(self) -> list[dict[str, str]]:
        """One dictionary a row, from ``ratings.csv``."""
        return read_csv(self._table("ratings.csv"), RATINGS, self.settings["data"].get("steps"))
