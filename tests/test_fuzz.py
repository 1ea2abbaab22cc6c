"""No argument of a public constructor, and no data, brings an error of torch or Python to the user."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest

pytest.importorskip("hypothesis")
sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import fuzz  # noqa: E402
import fuzz_recipes  # noqa: E402
import torch  # noqa: E402
from fuzz_inputs import NETWORKS, consumers  # noqa: E402
from fuzz_kinds import kind_of  # noqa: E402
from fuzz_table import Subject, subjects  # noqa: E402

EXAMPLES = 25


def told(faults):
    return "\n".join(map(str, faults))


@pytest.mark.parametrize("subject", subjects(), ids=lambda subject: subject.name)
def test_arguments_are_refused_by_name_or_accepted_rightly(subject):
    for argument in subject.arguments():
        calls, faults = fuzz.fuzz_argument(subject, argument, EXAMPLES)
        assert calls and not faults, told(faults)


@pytest.mark.parametrize("name", [name for name in consumers() if name not in NETWORKS])
def test_spoilt_data_is_refused_by_name_or_taken(name):
    calls, faults = fuzz.fuzz_input(name, consumers()[name], EXAMPLES)
    assert calls and not faults, told(faults)


@pytest.mark.parametrize("recipe", fuzz_recipes.RECIPES)
def test_recipe_options_end_in_one_line_or_are_accepted_rightly(recipe):
    for package in ("hydra", "pybullet", "gymnasium", "matplotlib", "tqdm"):
        pytest.importorskip(package)
    loaded = fuzz_recipes.load(fuzz.RECIPES, recipe)
    places = list(fuzz_recipes.leaves(loaded[1]))
    if recipe in ("ant_figure3", "ant_regimes"):  # they share the parts of ant_noise
        places = [place for place in places if "." not in place]
    for place in places:
        calls, faults = fuzz.fuzz_option(recipe, place, 3, loaded)
        assert not faults, told(faults)


def test_nothing_of_the_table_is_missing():
    assert len(subjects()) == len(list(fuzz.every_subject()))


def test_the_fuzz_finds_raw_and_unnamed_errors_and_what_is_wrongly_accepted():
    def raw(*, scale: float = 1.0) -> None:
        torch.zeros(2) @ torch.zeros(3)

    def careless(*, scale: float = 1.0) -> None:
        pass

    def unnamed(*, path: str = "") -> None:
        from torchrl_tsallis.data import load_policy

        load_policy("no such policy")

    found = {}
    for make in (raw, careless):
        _, faults = fuzz.fuzz_argument(Subject(make.__name__, make, dict), "scale", EXAMPLES)
        found[make.__name__] = {fault.kind for fault in faults}
    assert found == {"raw": {"raw"}, "careless": {"accepted"}}
    subject = Subject("unnamed", unnamed, dict, {"scale": kind_of("scale", "float")})
    with pytest.raises(FileNotFoundError) as caught:
        unnamed()
    assert fuzz.judged(caught.value, ["scale"]) == "unnamed" and fuzz.judged(caught.value, ["policy"]) is None
    assert set(subject.arguments()) == {"path", "scale"}


@pytest.mark.parametrize(
    ("annotation", "good", "bad"),
    [
        ("float", [0.5, 2, torch.tensor(0.5)], [math.nan, math.inf, -1, None, "1", True, [1.0]]),
        ("int", [0, 3], [2.5, -1, True, "3"]),
        ("bool", [True, torch.tensor(False)], [None, 0, "no"]),
        ("float | None", [None, 1.0], ["", -1.0]),
        ("Literal['first', 'eps']", ["eps"], ["last", 1]),
        ("Sequence[NestedKey]", [["a", ("b", "c")]], ["a", [""], [("a", 1)]]),
    ],
)
def test_annotations_say_what_may_be_given(annotation, good, bad):
    allowed = kind_of("scale", annotation)
    assert all(map(allowed, good)) and not any(map(allowed, bad))
