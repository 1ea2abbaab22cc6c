"""``python -m torchrl_tsallis.native build`` compiles the kernels; ``info`` says which are used."""

from __future__ import annotations

import argparse
import sys

from torchrl_tsallis.native.build import BuildError, build
from torchrl_tsallis.native.library import info


def main() -> int:
    """Runs a command; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m torchrl_tsallis.native", description=__doc__)
    parser.add_argument("command", choices=["build", "info"])
    if parser.parse_args().command == "build":
        try:
            build()
        except BuildError as error:
            sys.stderr.write(f"{error}\n")
            return 1
    sys.stdout.write(f"native kernels: {info()}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
