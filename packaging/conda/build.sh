#!/usr/bin/env bash
set -euo pipefail
cmake -S . -B build/conda -G Ninja ${CMAKE_ARGS:-} -DCMAKE_BUILD_TYPE=Release -DBUILD_SHARED_LIBS=ON -DGP2_BUILD_APPS=ON \
  -DGP2_BUILD_TESTS=OFF -DGP2_BUILD_PYTHON=ON -DGP2_WITH_MUJOCO=OFF -DGP2_WITH_MPI=OFF -DPython_EXECUTABLE="$PYTHON" \
  -DGP2_PYTHON_INSTALL_DIR="${SP_DIR#"$PREFIX"/}"
cmake --build build/conda --parallel "${CPU_COUNT:-1}"
cmake --install build/conda --prefix "$PREFIX"
