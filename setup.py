"""Hands the build of the Python package to CMake; everything else is in pyproject.toml."""

import re
from pathlib import Path

from skbuild import setup

project = Path(__file__).with_name("CMakeLists.txt").read_text(encoding="utf-8")
version = re.search(r"^project\(gp2 VERSION ([\d.]+)", project, re.MULTILINE)

setup(
    version=version[1],
    packages=["gp2"],
    package_dir={"": "python"},
    cmake_install_dir="python",
    cmake_args=[
        "-DGP2_BUILD_PYTHON=ON",
        "-DGP2_BUILD_APPS=OFF",
        "-DGP2_BUILD_TESTS=OFF",
        "-DGP2_INSTALL=OFF",
        "-DBUILD_SHARED_LIBS=OFF",
        "-DGP2_PYTHON_INSTALL_DIR=.",
        "-DGP2_PYTHON_BUNDLE=ON",
    ],
)
