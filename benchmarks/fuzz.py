"""Fuzz of the public constructors, of the data that they are given, and of the recipes' options.

Every argument gets values of wrong types, signs and sizes, beside valid ones for the others. Counted are calls that

- are raw: the error comes from outside of the package (torch, tensordict, NumPy, Python),
- do not name the argument in their message, and
- accept a value that the argument's kind does not allow.

    python benchmarks/fuzz.py --examples 50
"""

from __future__ import annotations

import argparse
import contextlib
import io
import itertools
import json
import logging
import os
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

sys.path.insert(0, str(Path(__file__).parent))

import fuzz_recipes
import torch
from fuzz_inputs import consumers, mutations
from fuzz_kinds import values
from fuzz_table import Reached, Subject, every_subject, subjects
from hypothesis import HealthCheck, Phase, given, seed, settings

import torchrl_tsallis

ROOT = Path(torchrl_tsallis.__file__).parent
RECIPES = ROOT.parent / "recipes"
__all__ = ["every_subject", "everything", "fuzz_argument", "fuzz_input", "judged", "subjects"]

#: What messages may call an argument, beside its name.
ALSO = {
    "demonstrations": ("demonstrations", "trajector"),
    "data": ("demonstrations",),
    "actor_network": ("actor",),
    "path": ("file", "cannot write", "cannot read"),
    "kind": ("logger",),
    "keys": ("the demonstrations have no",),
    "policies": ("policy",),
    "size": ("width", "height"),
    "mean": ("observation_mean", "observation_std"),
}


class Fault(NamedTuple):
    """A call that went wrong."""

    subject: str
    argument: str
    kind: str  # raw, unnamed or accepted
    value: str
    message: str


def judged(error: BaseException, names: Sequence[str]) -> str | None:
    """What is wrong with an error; None if it is as it should be."""
    file = Path(traceback.extract_tb(error.__traceback__)[-1].filename)
    own = ROOT in file.parents or RECIPES in file.parents
    if not own or not isinstance(error, (TypeError, ValueError, KeyError, OSError, NotImplementedError, SystemExit)):
        return "raw"
    return None if any(name in str(error) for name in names) else "unnamed"


def reached(error: BaseException | None) -> bool:
    """Whether the error says that the arguments were accepted, as it is or as the cause of another one."""
    return error is not None and (isinstance(error, Reached) or reached(error.__cause__ or error.__context__))


def shown(value: Any) -> str:
    """A value in a few characters."""
    try:
        return repr(value)[:60].replace("\n", " ")
    except Exception as error:
        return f"{type(value).__name__} ({error})"


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """A new folder to work in; no warnings, no logs, and torch's random numbers as they were."""
    before = os.getcwd()
    state = torch.get_rng_state()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logging.disable(logging.CRITICAL)
        inner = Path(folder) / "a" / "b"
        inner.mkdir(parents=True)
        os.chdir(inner)
        try:
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                yield
        finally:
            os.chdir(before)
            logging.disable(logging.NOTSET)
            torch.set_rng_state(state)


class Hung(BaseException):
    """Raised in a call that does not come to an end."""


@contextlib.contextmanager
def ended(seconds: int = 10) -> Iterator[None]:
    """Ends what takes longer, which counts as an error of another one's."""

    def end(*_: Any) -> None:
        raise Hung(f"took more than {seconds} s")

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def call(subject: Subject, arguments: dict[str, Any]) -> None:
    """Calls; an ``__init__`` on an object that is made for it."""
    if subject.make.__name__ == "__init__":
        owner = sys.modules[subject.make.__module__].__dict__[subject.make.__qualname__.split(".")[0]]
        subject.make(owner.__new__(owner), **arguments)
    else:
        subject.make(**arguments)


def too_many(argument: str, value: Any) -> bool:
    """Whether a number of things to do would never end; processes take seconds each to begin."""
    try:
        return not float(value) <= (0 if argument == "workers" else 4)
    except Exception:
        return False


def fuzz_argument(subject: Subject, argument: str, examples: int) -> tuple[int, list[Fault]]:
    """Calls with many values of one argument; their number, and the faults."""
    allowed, faults, count = subject.arguments()[argument], [], 0

    @seed(crc32(f"{subject.name}.{argument}".encode()))
    @settings(max_examples=examples, database=None, deadline=None, phases=[Phase.generate],
              suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(values())
    def one(value: Any) -> None:
        nonlocal count
        if argument in subject.few and too_many(argument, value) and allowed(value):
            return
        count += 1
        text = shown(value)
        try:
            with ended():
                call(subject, {**subject.valid(), argument: value})
        except BaseException as error:
            if reached(error):
                if not allowed(value):
                    faults.append(Fault(subject.name, argument, "accepted", text, ""))
                return
            if callable(value) and allowed(value):
                return  # what an own function raises is its own matter
            kind = judged(error, (argument, *ALSO.get(argument, ())))
            if kind:
                faults.append(Fault(subject.name, argument, kind, text, f"{type(error).__name__}: {error}"[:150]))
            return
        if not allowed(value):
            faults.append(Fault(subject.name, argument, "accepted", text, ""))

    with quiet():
        one()
    return count, faults


def fuzz_input(name: str, consume: Any, examples: int) -> tuple[int, list[Fault]]:
    """Calls with data of which one entry is spoilt; their number, and the faults. Nothing is taken for accepted."""
    faults, count = [], 0

    @seed(crc32(name.encode()))
    @settings(max_examples=examples, database=None, deadline=None, phases=[Phase.generate],
              suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(mutations())
    def one(spoilt: Any) -> None:
        nonlocal count
        count += 1
        try:
            with ended():
                consume(spoilt.data)
        except BaseException as error:
            kind = judged(error, spoilt.names)
            if kind:
                faults.append(Fault(name, "data", kind, spoilt.what, f"{type(error).__name__}: {error}"[:150]))

    with quiet():
        one()
    return count, faults


def fuzz_option(recipe: str, option: str, examples: int, loaded: Any = None) -> tuple[int, list[Fault]]:
    """Starts a recipe with many values of one option; the number of starts, and the faults."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    run, cfg, patches = loaded or fuzz_recipes.load(RECIPES, recipe)
    before, faults, count = OmegaConf.select(cfg, option), [], 0

    @seed(crc32(f"{recipe}.{option}".encode()))
    @settings(max_examples=examples, database=None, deadline=None, phases=[Phase.generate],
              suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(fuzz_recipes.values())
    def one(value: Any) -> None:
        nonlocal count
        own = cfg.copy()
        try:
            OmegaConf.update(own, option, value, merge=False)
        except (OmegaConfBaseException, ValueError, OverflowError):
            return  # Hydra's own check of a type
        value = OmegaConf.select(own, option)  # as it has converted it
        shutil.rmtree("outputs", ignore_errors=True)
        count += 1
        error: BaseException | None = None
        with contextlib.ExitStack() as stack:
            for patch in patches:
                stack.enter_context(patch)
            try:
                with ended():
                    run(own)
            except BaseException as caught:
                error = caught
        if error is None or reached(error):
            if not fuzz_recipes.allowed(option, before, value):
                faults.append(Fault(recipe, option, "accepted", shown(value), ""))
            return
        leaf = option.split(".")[-1]
        kind = judged(error, (option, leaf, leaf.removesuffix("_key"))) if isinstance(error, SystemExit) else "raw"
        if kind:
            faults.append(Fault(recipe, option, kind, shown(value), f"{type(error).__name__}: {error}"[:150]))

    with quiet():
        one()
    return count, faults


def all_options(examples: int, chosen: str = "") -> Iterator[tuple[str, str, int, list[Fault]]]:
    """All options of all recipes."""
    for recipe in fuzz_recipes.RECIPES:
        if chosen in recipe and (RECIPES / f"{recipe}.py").exists():  # an older commit lacks some
            loaded = fuzz_recipes.load(RECIPES, recipe)
            for option in fuzz_recipes.leaves(loaded[1]):
                yield (f"recipe {recipe}", option, *fuzz_option(recipe, option, examples, loaded))


def everything(examples: int, chosen: str = "") -> Iterator[tuple[str, str, int, list[Fault]]]:
    """All subjects, argument by argument, and all consumers of data."""
    for subject in subjects():
        if chosen in subject.name:
            for argument in subject.arguments():
                yield (subject.name, argument, *fuzz_argument(subject, argument, examples))
    for name, consume in consumers().items():
        if chosen in name:
            yield (name, "data", *fuzz_input(name, consume, examples))


def main() -> None:
    """Prints the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--examples", type=int, default=50, help="values of an argument")
    parser.add_argument("--only", default="", help="part of the names of what is fuzzed")
    parser.add_argument("--show", action="store_true", help="print one fault of each kind and argument")
    parser.add_argument("--recipes", action="store_true", help="the recipes alone")
    parser.add_argument("--json", help="file for the counts by constructor")
    options = parser.parse_args()
    table: dict[str, Counter[str]] = {}
    found = itertools.chain(
        [] if options.recipes else everything(options.examples, options.only),
        all_options(options.examples, options.only),
    )
    for name, argument, calls, faults in found:
        row = table.setdefault(name, Counter())
        row["arguments"] += 1
        row["calls"] += calls
        row["faulty"] += bool(faults)
        row.update(fault.kind for fault in faults)
        if options.show:
            first = {(fault.kind, fault.message.split(":")[0]): fault for fault in reversed(faults)}
            for fault in first.values():
                print(f"{name}.{argument}: {fault.kind} {fault.value} {fault.message}", flush=True)
    total: Counter[str] = Counter()
    for row in table.values():
        total += row
    print(f"{'':28}{'arguments':>10}{'calls':>8}{'raw':>6}{'unnamed':>8}{'accepted':>9}{'faulty':>7}")
    for name, row in [*table.items(), ("all", total)]:
        print(
            f"{name:28}{row['arguments']:10}{row['calls']:8}{row['raw']:6}{row['unnamed']:8}{row['accepted']:9}"
            f"{row['faulty']:7}"
        )
    if options.json:
        Path(options.json).write_text(json.dumps({name: dict(row) for name, row in table.items()}, indent=1))


if __name__ == "__main__":
    main()
