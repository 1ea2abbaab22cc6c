"""The model card of a policy: what it is, what it was made of, and how it is loaded."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_TEXT = """\
# {title}

A policy for continuous actions, trained by behavioral cloning that rates every demonstration (torchrl_tsallis).
It was not evaluated: whether it does the task has to be tried, first where nothing can break.

## Data
{data}

## Method
{method}

## Files
- `policy.safetensors`: parameters of the policy, of scaled observations and actions
- `rating.safetensors`: settings and running statistics of the rating
- `scaling.json`: centre and scale of every dimension
- `run.json`: all of the above and below, for programs

Nothing in the folder is run as code when it is opened.

## How to load it
```python
from torchrl_tsallis.run import Run

run = Run.open("{folder}")
actor = run.actor()            # TorchRL: reads "observation" [{obs_dim}], writes "action" [{action_dim}]
policy = run.numpy_policy()    # NumPy alone: policy(observation) gives the mean action
run.surprise("DATA")           # how unlikely each action of other demonstrations is, in decades
```
`tsallis export "{folder}" --onnx policy.onnx` writes the mean policy for other runtimes. Observations and actions have
the units of the data; the scaling is inside.{observation}

## Limits
It imitates what most of the demonstrations do in a state, good or bad, and knows nothing of states that they do not
show. Ratings say what is unlikely, not what is wrong.

## Made by
{versions}

`{command}`
"""


def model_card(settings: Mapping[str, Any], folder: str) -> str:
    """The card as Markdown.

    Args:
        settings: what ``run.json`` says.
        folder: where the run is, for the example.

    Returns:
        The text.
    """
    data, method, train = settings["data"], settings["method"], settings["train"]
    arguments, name = settings["policy"]["arguments"], data.get("path") or "data in memory"
    episodes = "" if data.get("episodes") is None else f" in {data['episodes']} episodes"
    facts = {
        "Source": f"`{_inline(name)}` ({data['format']})",
        "Size": f"{data['steps']} steps{episodes}",
        "Observation": ", ".join(f"`{_inline(key)}`" for key in data["keys"]["observation"]),
        "Action": ", ".join(f"`{_inline(key)}`" for key in data["keys"]["action"]),
        "Identity (SHA-256 of the numbers)": f"`{data['identity']}`",
    }
    if data.get("filter_key"):
        facts["Subset"] = f"`{_inline(data['filter_key'])}`"
    how = {
        "Rating": ", ".join(
            _said(value) if key == "rating" else f"{key} {_said(value)}" for key, value in method.items()
        ),
        "Policy": f"`{settings['policy']['factory']}`, "
        + ", ".join(f"{key} {value}" for key, value in arguments.items()),
        "Training": ", ".join(f"{key} {_said(value)}" for key, value in train.items()),
    }
    layout = data.get("layout") or []
    order = ", ".join(f"`{_inline(key)}` {first}:{end}" for key, first, end in layout)
    return _TEXT.format(
        title=f"Policy of {_inline(str(name).rstrip('/').rpartition('/')[2])}",
        data=_listed(facts),
        method=_listed(how),
        folder=folder.replace("\\", "\\\\").replace('"', '\\"'),
        obs_dim=arguments["obs_dim"],
        action_dim=arguments["action_dim"],
        observation=f" The observation is, in this order: {order}." if len(layout) > 1 else "",
        versions=_listed(settings["versions"]),
        command=_inline(settings["command"]),
    )


def _inline(text: Any) -> str:
    """Text for a line of Markdown: names of files and keys may hold anything."""
    return " ".join(str(text).replace("`", "'").split())


def _said(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _listed(facts: Mapping[str, Any]) -> str:
    return "\n".join(f"- {key}: {value}" for key, value in facts.items())
