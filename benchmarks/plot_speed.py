"""The pictures of docs/speed.md from its raw file.

In a shell::

python benchmarks/plot_speed.py --input docs/results/speed.csv --output docs/results/speed.png
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

from matplotlib.figure import Figure

from torchrl_tsallis.jobs import atomic_path

#: What is drawn against each size: label, column "what", column "kernels".
LINES = [
    ("TorchRL's Trainer, BCLoss, Adam", "Trainer + BCLoss + Adam", "torch"),
    ("proposal, torch", "proposal, stacked", "torch"),
    ("proposal, native kernels", "proposal, stacked", "native"),
    ("its products alone, batched", "products of proposal, batched", "torch"),
]
SIZES = {"members": "stacked members", "batch": "batch", "width": "width", "rows": "samples"}
USUAL = {"members": "24", "batch": "256", "width": "100", "threads": "1", "rows": "29970"}


def points(rows: list[dict[str, str]], size: str, what: str, kernels: str) -> list[tuple[int, float]]:
    """Milliseconds a member-step over one of the sizes, the others as usual; of the last measurement of each."""
    found = {}
    for row in rows:
        usual = all(row[name] == value for name, value in USUAL.items() if name != size)
        if usual and row["what"] == what and row["kernels"] == kernels:
            found[int(row[size])] = float(row["milliseconds"])
    return sorted(found.items())


def draw(rows: list[dict[str, str]], path: Path) -> None:
    """A panel for each size that was varied."""
    figure = Figure(figsize=(13, 3), dpi=150, layout="constrained")
    for axes, (size, label) in zip(figure.subplots(1, len(SIZES)), SIZES.items(), strict=True):
        for (name, what, kernels), style in zip(LINES, ("s--", "o-", "o-", ":"), strict=True):
            line = points(rows, size, what, kernels)
            axes.plot([x for x, _ in line], [y for _, y in line], style, label=name, markersize=4)
        ticks = sorted({x for _, what, kernels in LINES for x, _ in points(rows, size, what, kernels)})
        axes.set_xscale("log", base=2)
        axes.set_yscale("log")
        axes.set_xticks(ticks, [str(x) for x in ticks], fontsize=7)
        axes.minorticks_off()
        axes.set_xlabel(label)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("ms a member-step")
    figure.axes[-1].legend(frameon=False, fontsize=6, loc="center", bbox_to_anchor=(0.5, 0.72))
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:])


def main() -> None:
    """Draws."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--input", type=Path, default=Path("docs/results/speed.csv"))
    parser.add_argument("--output", type=Path, default=Path("docs/results/speed.png"))
    args = parser.parse_args()
    with open(args.input, newline="") as file:
        draw(list(csv.DictReader(file)), args.output)


if __name__ == "__main__":
    main()
