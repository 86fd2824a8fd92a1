#!/bin/sh
# Install the locked test environment into .venv and run all tests. Debian 12 or 13, Ubuntu 24.04; root or sudo.
set -eu
cd "$(dirname "$0")"
as_root=""
[ "$(id -u)" = 0 ] || as_root="sudo"
$as_root apt-get update
# the libraries after python3-pip are those that SUMO, NGSolve and OpenCV link
$as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends git python3-venv python3-pip \
  libx11-6 libxext6 libxrender1 libsm6 libgl1 libglib2.0-0 libexpat1 libatomic1 libgfortran5
$as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends libllvm19 chromium ||
  echo "without LLVM 19 and Chromium, the comparison with Mitsuba and the browser tests are skipped"
python3 -m venv .venv
.venv/bin/pip install --no-compile --require-hashes -r requirements.lock
.venv/bin/pip install --no-deps -e .
# keep compiled imports: the tests start many processes
unset PYTHONDONTWRITEBYTECODE
# two processes share the processors: one thread each for matrices and trees, and no busy waiting
OMP_NUM_THREADS=1 OMP_WAIT_POLICY=passive .venv/bin/python -m pytest -n 2 --dist worksteal "$@"
