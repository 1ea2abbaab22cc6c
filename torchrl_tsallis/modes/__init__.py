"""Modes of behaviour in demonstrations, found without labels: episodes that lie apart, or mixtures of policies."""

from torchrl_tsallis.modes.consensus import adjusted_rand_index, consensus, together
from torchrl_tsallis.modes.distributions import areas_between, behaviour, distribution_functions
from torchrl_tsallis.modes.find import find_modes, find_modes_of_each
from torchrl_tsallis.modes.found import Modes
from torchrl_tsallis.modes.likelihood import episode_means, robust_log_prob
from torchrl_tsallis.modes.mixture import EpisodeMixture
from torchrl_tsallis.modes.responsibilities import Annealing, random_responsibilities, responsibilities
from torchrl_tsallis.modes.sampler import EpisodeSampler, make_episode_buffer
from torchrl_tsallis.modes.separation import separated, silhouettes
from torchrl_tsallis.modes.train import train_mixtures

__all__ = [
    "Annealing",
    "EpisodeMixture",
    "Modes",
    "EpisodeSampler",
    "adjusted_rand_index",
    "areas_between",
    "behaviour",
    "consensus",
    "distribution_functions",
    "episode_means",
    "find_modes",
    "find_modes_of_each",
    "make_episode_buffer",
    "random_responsibilities",
    "responsibilities",
    "robust_log_prob",
    "separated",
    "silhouettes",
    "together",
    "train_mixtures",
]
