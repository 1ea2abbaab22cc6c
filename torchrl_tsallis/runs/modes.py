"""From a file of demonstrations to its modes: :func:`modes`, and the demonstrations of one of them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_tsallis._checks import check_number
from torchrl_tsallis._device import check_device
from torchrl_tsallis.data.modes_folder import KIND, ModesFolder
from torchrl_tsallis.data.rows import take_rows
from torchrl_tsallis.modes.find import UPDATES, find_modes
from torchrl_tsallis.modes.found import AGREE, By, Modes
from torchrl_tsallis.modes.separation import SEPARATED, SURE
from torchrl_tsallis.modes.train import BETA, LR, steps_between
from torchrl_tsallis.runs.differences import mode_differences
from torchrl_tsallis.runs.folder import FORMAT, RUN, check_free, new_folder, write_csv, write_json
from torchrl_tsallis.runs.labels import compare_labels, read_labels
from torchrl_tsallis.runs.saved import save_tensors, versions
from torchrl_tsallis.runs.source import Source, identity, load_source

#: How much larger than the next one a mode has to be for a recommendation that is sure.
LARGER = 1.25
MODES = ("episode", "source", "steps", "mode", "membership")
LABELS = ("episode", "source", "label")
DIFFERENCES = ("mode", "other", "part", "action", "difference")


class Words(NamedTuple):
    """What is said of modes, by what they were found by.

    Attributes:
        certain: least certainty of a mode that is recommended without care.
        sure: least evidence for that.
        least: evidence for more than one mode.
        one: why there is one mode.
        doubt: what is said of less certainty.
        hardly: what is said of less evidence.
    """

    certain: float
    sure: float
    least: float
    one: str
    doubt: str
    hardly: str


WORDS = {
    "distributions": Words(
        SEPARATED,
        SURE,
        SEPARATED,
        "no episodes lie apart from the others",
        "its episodes are hardly nearer to one another than to others ({:.2f}; 1 is most)",
        f"one habit that varies without a gap can look like this too (up to {SURE:g})",
    ),
    "policies": Words(
        0.8,
        AGREE,
        AGREE,
        "the starts do not agree on several",
        "the starts agree on it by {:.2f} only (1 is always)",
        "the starts hardly agree on anything, as where there is one mode",
    ),
}


def modes(
    path_or_data: str | os.PathLike[str] | TensorDictBase,
    out: str | os.PathLike[str],
    *,
    obs: str | Sequence[str] | None = None,
    action: str | Sequence[str] | None = None,
    episode: str | None = None,
    format: str | None = None,
    filter_key: str | None = None,
    labels: str | None = None,
    by: By = "distributions",
    components: int | None = None,
    starts: int = 4,
    updates: int = UPDATES,
    batch_size: int = 256,
    seed: int = 0,
    device: str = "cpu",
    progress: bool = True,
    overwrite: bool = False,
    command: str = "",
) -> ModesFolder:
    """Finds modes of behaviour among demonstrations; see :func:`~torchrl_tsallis.modes.find_modes`.

    Args:
        path_or_data: as for :func:`~torchrl_tsallis.run.rate`, and so are the next five.
        out: folder to write, whole or not at all.
        obs: keys of the observation in the file.
        action: key of the action in the file.
        episode: key of the episode's number (npz, CSV).
        format: name of the format.
        filter_key: subset of the file's episodes.
        labels: key of what is known of each episode, such as its operator, which what was found is compared with;
            ``mask`` for the filter keys of robomimic. It is never used in the search. Default: none.
        by: what modes are found by: ``distributions`` of what happens in an episode, or ``policies``, mixtures of them.
        components: by distributions the number of modes, whether they lie apart or not; by policies the components of a
            mixture, and modes are looked for although one may be enough. Default: as many modes as there are.
        starts: of mixtures; by policies, as are the next two.
        updates: of the responsibilities, an epoch between two.
        batch_size: samples a step and component.
        seed: of starts and policies.
        device: of the policies.
        progress: whether to show bars.
        overwrite: whether an earlier run in ``out`` is replaced, once this one is done.
        command: what ``run.json`` says that it was made by.

    Returns:
        The folder, opened.

    Raises:
        FileExistsError: if ``out`` holds something.
        ValueError: if data or a number cannot be used; the message says what to do.

    Examples:
        >>> import tempfile
        >>> from tensordict import TensorDict
        >>> rows = {"observation": torch.rand(80, 2), "action": torch.rand(80, 1), "episode": torch.arange(80) // 10}
        >>> folder = os.path.join(tempfile.mkdtemp(), "modes")
        >>> found = modes(TensorDict(rows, [80]), folder, updates=2, progress=False)
        >>> len(found.names), sum(mode["episodes"] for mode in found.summary["modes"])
        (8, 8)
    """
    check_device(device)
    check_free(out, overwrite, path_or_data if isinstance(path_or_data, (str, os.PathLike)) else None)
    chosen = {"obs": obs, "action": action, "episode": episode, "format": format, "filter_key": filter_key}
    source = load_source(path_or_data, **chosen)  # type: ignore[arg-type]
    known = None if labels is None else read_labels(path_or_data, source, labels, {**chosen, "observation": obs})
    numbers: dict[str, Any] = {"starts": starts, "updates": updates, "batch_size": batch_size, "seed": seed}
    numbers |= {"by": by, "components": components}
    with new_folder(out, overwrite=overwrite) as folder:
        found = find_modes(source.data, **numbers, always=components is not None, device=device, progress=progress)
        episodes = source.episodes()
        lengths = episodes.lengths.tolist()
        number = found.of_episodes
        columns = (source.names, lengths, number.tolist(), found.membership.tolist())
        write_csv(folder / "modes.csv", MODES, zip(range(len(number)), *columns, strict=True))
        save_tensors(folder / "pairs.safetensors", {"pairs": found.pairs.float()})
        summary = describe(found, lengths, components is not None)
        if known is not None:
            summary["labels"] = {"key": labels, **compare_labels(known, number.tolist())}
            write_csv(folder / "labels.csv", LABELS, zip(range(len(number)), source.names, known, strict=True))
        write_json(folder / "summary.json", summary)
        steps = updates * steps_between(len(source.data), batch_size)  # as a component of a mixture
        of_policies = {"steps": steps, "batch_size": batch_size, "seed": seed}
        compared, apart = mode_differences(
            source.data, found.groups, episodes, **of_policies, device=device, progress=progress
        )
        write_csv(folder / "differences.csv", DIFFERENCES, rows_of(compared, apart))
        write_json(
            folder / RUN,
            {
                "format": FORMAT,
                "kind": KIND,
                "method": {"rating": "peak", "beta": BETA},
                "data": source.to_json(),
                "train": {**numbers, "lr": LR},
                "versions": versions(),
                "command": command or "torchrl_tsallis.run.modes",
            },
        )
    return ModesFolder.open(out)


def describe(found: Modes, lengths: Sequence[int], asked: bool = False) -> dict[str, Any]:
    """What ``summary.json`` says: the modes, the one to imitate, and how sure both are.

    Args:
        found: the modes.
        lengths: steps of each episode.
        asked: whether modes were asked for, however little speaks for them.
    """
    share, certainty = found.share.tolist(), found.certainty.tolist()
    listed = [
        {
            "mode": k,
            "episodes": len(group),
            "steps": sum(lengths[e] for e in group),
            "share": share[k],
            "certainty": certainty[k],
        }
        for k, group in enumerate(found.groups)
    ]
    best = found.recommended
    rest = max((share[k] for k in range(len(share)) if k != best), default=0.0)
    words, reasons = WORDS[found.by], []
    if len(found.groups) > 1:
        if certainty[best] < words.certain:
            reasons.append(words.doubt.format(certainty[best]))
        if share[best] < LARGER * rest:
            reasons.append("another mode is about as large")
        if found.evidence < words.sure:
            reasons.append(words.hardly)
    large = [mode for mode in listed if mode["episodes"] > 1]
    alone = len(listed) - len(large)
    if len(found.groups) == 1:
        sentence = f"One mode: {words.one} ({found.evidence:.2f}, at least {words.least:g} is needed)."
    else:
        text = ", ".join(f"{mode['mode']} ({mode['episodes']} episodes)" for mode in large)
        sentence = (
            f"{len(large)} modes of more than one episode: {text}; {alone} episodes are alone. Imitate mode {best}"
        )
        sentence += f", with care: {'; '.join(reasons)}." if reasons else "."
    return {
        "modes": listed,
        "recommended": best,
        "sure": not reasons,
        "reasons": reasons,
        "by": found.by,
        "evidence": found.evidence,
        "asked": asked,
        "sentence": sentence,
    }


def rows_of(compared: Sequence[int], apart: Tensor) -> Iterator[tuple[Any, ...]]:
    """Lines of ``differences.csv``: each pair of modes once."""
    for a, b in combinations(range(len(compared)), 2):
        for part, row in enumerate(apart[a, b].tolist()):
            for action, value in enumerate(row):
                yield compared[a], compared[b], part, action, value


def mode_source(folder: str | os.PathLike[str], mode: int | str) -> Source:
    """The demonstrations of one mode, or of each, read again from where they were.

    Args:
        folder: that :func:`modes` left.
        mode: number of the mode, or ``each``: all rows, whose observation goes on with a 1 for the episode's mode and a
            0 for each other one of more than one episode; an episode alone has zeros.

    Returns:
        The rows of its episodes, with their names.

    Raises:
        FileNotFoundError: if folder or data are not there.
        ValueError: if there is no such mode, the data were in memory, or they are others now.
    """
    if mode != "each":
        check_number("mode", mode, low=0, integer=True)
    found = ModesFolder.open(folder)
    names, about = found.names if isinstance(mode, str) else found.episodes_of(mode), found.run["data"]
    if about["format"] == "memory":
        raise ValueError(f"the data of {str(folder)!r} were in memory: save them, and find the modes of the file")
    keys = about["keys"]
    action = keys["action"] if len(keys["action"]) > 1 else keys["action"][0]
    chosen = {"episode": about.get("episode"), "filter_key": about.get("filter_key"), "format": about["format"]}
    source = load_source(about["path"], obs=keys["observation"], action=action, **chosen)
    if identity(source.data) != about["identity"]:
        raise ValueError(f"{about['path']!r} has changed since its modes were found: find them again")
    chosen = {**source.chosen, "mode": str(mode)}
    if isinstance(mode, str):
        numbers, counts = torch.from_numpy(found.mode).unique(return_counts=True)
        large = numbers[counts > 1]
        asked = torch.from_numpy(found.mode)[source.episodes().of_rows()][:, None] == large
        width = source.data["observation"].shape[1]
        data = source.data.clone(False)
        data["observation"] = torch.cat([data["observation"], asked.to(data["observation"])], 1)
        layout = (*source.layout, ("mode", width, width + len(large)))
        return replace(source, data=data, layout=layout, chosen=chosen)
    own = torch.tensor([name in set(names) for name in source.names])
    data = take_rows(source.data, own[source.episodes().of_rows()])
    return replace(source, data=data, names=tuple(names), chosen=chosen)
