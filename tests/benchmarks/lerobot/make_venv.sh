#!/bin/sh
# Make the environment of `make bench-lerobot`, apart from the product's: LeRobot asks for older
# packages and a newer Python. Usage: make_venv.sh FOLDER (python3.11 or $PYTHON).
# Wanted on the machine: the FFmpeg 4 … 7 libraries (Debian: ffmpeg), which torchcodec loads.
set -eu
venv=${1:?"usage: make_venv.sh FOLDER"}
here=$(cd "$(dirname "$0")" && pwd)
root=$(cd "$here/../../.." && pwd)
"${PYTHON:-python3.11}" -m venv "$venv"
pip() {
	"$venv/bin/python" -m pip --disable-pip-version-check --quiet "$@"
}
# Exactly the pinned torch without an NVIDIA runtime: where the index offers only CUDA builds, give
# the CPU index by PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu.
pip install -r "$here/requirements.txt"
# Its own list asks for torch < 2.12 with torchvision and for Python 3.12; prepare.py deals with both.
pip install --no-deps --ignore-requires-python lerobot==0.6.1
"$venv/bin/python" "$here/prepare.py"
pip install --no-deps -e "$root"
touch "$venv/.complete"
