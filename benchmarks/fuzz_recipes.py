"""Fuzz of the recipes' options: each one gets values of any kind, up to where the data would be made."""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Callable, Iterator
from numbers import Integral, Real
from pathlib import Path
from typing import Any
from unittest import mock

from fuzz_kinds import INFINITE
from fuzz_table import Reached
from hypothesis import strategies as st

#: Options that may be null, though they are not by default.
ABSENT = {"show"}
#: Recipes, and where each begins with its data.
RECIPES: dict[str, tuple[str, ...]] = {
    "ant_noise": ("demonstrations",),
    "ant_figure3": ("run", "read_raw"),
    "ant_regimes": ("run", "read_raw"),
    "page_flip": ("demonstrations",),
    "collect_ant": ("collect_dataset",),
    "collect_flip": ("collect_flips",),
    "train_experts": ("train", "write_card"),
}
#: Options in which a value of another kind than the default's has a meaning.
FREE = ("hydra", "methods", "grids", "ratings", "ray", "card.history")
FREE += ("_target_", "_partial_", "_convert_", "process_group")


def _reach(*_: Any, **__: Any) -> Any:
    raise Reached


def load(recipes: Path, name: str) -> tuple[Callable[[Any], Any], Any, list[Any]]:
    """The recipe's main function, its configuration, and patches that end it where the data would be made."""
    from hydra import compose, initialize_config_dir

    if str(recipes) not in sys.path:
        sys.path.insert(0, str(recipes))
    module = importlib.import_module(name)
    with initialize_config_dir(str(recipes), version_base="1.3"):
        cfg = compose(name)
    patches = [mock.patch.object(module, place, _reach) for place in RECIPES[name]]
    # Folders of results are removed by names that are made of options.
    patches += [mock.patch("shutil.rmtree"), mock.patch.dict(sys.modules)]
    return module.main, cfg, patches


def leaves(cfg: Any, before: str = "") -> Iterator[str]:
    """All options by their places."""
    from omegaconf import DictConfig, OmegaConf

    for name in cfg:
        place = f"{before}{name}"
        if any(part in place.split(".") or place == part for part in FREE):
            continue
        value = None if OmegaConf.is_missing(cfg, name) else cfg._get_node(name)
        if isinstance(value, DictConfig) and len(value):
            yield from leaves(value, f"{place}.")
        elif not OmegaConf.is_missing(cfg, name):
            yield place


def values() -> st.SearchStrategy[Any]:
    """What YAML can hold."""
    numbers = [0, -1, 1, 2, 2**62, 10**30, 10**400, math.nan, math.inf, -math.inf, -0.5, 2.5, 1e308, 5e-324]
    others = [
        None,
        True,
        False,
        "",
        "auto",
        "1",
        "nan",
        "../x",
        "a\0b",
        [],
        {},
        [[1]],
        {"a": 1},
        [None],
        [-1, 2],
        ["a"],
    ]
    return st.one_of(
        st.sampled_from(numbers),
        st.sampled_from(others),
        st.floats(),
        st.text(max_size=3).filter(lambda text: "$" not in text),
    )


def allowed(option: str, before: Any, value: Any) -> bool:
    """Whether a value is of the kind of the default: a number like it, or of no kind that a default tells."""
    from omegaconf import OmegaConf

    if OmegaConf.is_config(value):
        value = OmegaConf.to_container(value)
    if value is None and option in ABSENT:
        return True
    if isinstance(before, bool):
        return isinstance(value, bool)
    if isinstance(before, Real):
        good = isinstance(value, Real) and not isinstance(value, bool) and value == value
        if isinstance(value, list):  # one or a list, for some
            return bool(value) and all(allowed(option, before, part) for part in value)
        if not isinstance(value, Real):
            return False
        whole = not isinstance(before, Integral) or isinstance(value, Integral) or value % 1 == 0
        return good and whole and (abs(value) < math.inf or option.split(".")[-1] in INFINITE)
    if isinstance(before, str):
        return isinstance(value, str) or (isinstance(value, list) and all(isinstance(one, str) for one in value))
    return True
