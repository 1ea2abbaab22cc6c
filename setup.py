"""Only for wheels that bring the native kernels: ``TSALLIS_NATIVE_BUILD=1 python -m build --wheel``."""

import os

from setuptools import Extension, setup

KERNELS = Extension(
    "torchrl_tsallis.native._kernels",
    ["torchrl_tsallis/native/src/kernels.cpp"],
    depends=["torchrl_tsallis/native/src/vector.inc"],
    extra_compile_args=["-O3", "-std=c++17", "-fno-math-errno", "-w"],
    extra_link_args=["-pthread"],
    language="c++",
)

setup(ext_modules=[KERNELS] if os.environ.get("TSALLIS_NATIVE_BUILD") == "1" else [])
