#!/bin/sh
# Install glintrack into .venv and simulate the packaged case `quickstart`. Debian 12 or 13, Ubuntu 24.04; root or sudo.
set -eu
cd "$(dirname "$0")"
as_root=""
[ "$(id -u)" = 0 ] || as_root="sudo"
$as_root apt-get update
$as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends python3-venv python3-pip
python3 -m venv .venv
.venv/bin/pip install -c constraints.txt .
output=result-quickstart
[ ! -e "$output" ] || output="result-quickstart-$(date +%Y%m%d-%H%M%S)"  # a second call keeps the first result
.venv/bin/glintrack run quickstart -o "$output"
.venv/bin/glintrack report "$output" -o "$output.html"
