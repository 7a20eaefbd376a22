#!/usr/bin/env bash
# Run the README's two commands of the first hour, install and demo, in a fresh virtual environment, and print how long
# they took and how large the environment is.
#
#   scripts/first_run.sh            # installs this checkout with constraints.txt
set -euo pipefail
checkout="$(cd "$(dirname "$0")/.." && pwd)"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT

"${PYTHON:-python3}" -m venv "$work/venv"
# shellcheck disable=SC1091
. "$work/venv/bin/activate"
empty="$(du -sm "$work/venv" | cut -f1)"

# Built from a copy, so that the checkout stays as it is.
mkdir "$work/checkout"
(cd "$checkout" && git ls-files -z | tar --create --null --files-from=-) | tar --extract --directory="$work/checkout"

cd "$work/checkout"
start="$SECONDS"
pip install --quiet -c constraints.txt .
installed="$SECONDS"
cd "$work"
objectflow demo
finished="$SECONDS"

size="$(du -sm "$work/venv" | cut -f1)"
torch="$(du -sm "$(python -c 'import torch; print(torch.__path__[0])' 2>/dev/null)" | cut -f1)"
echo
echo "install: $((installed - start)) s, $((size - empty)) MB on disk, of which torch $torch MB"
echo "demo:    $((finished - installed)) s, the first import of all libraries included"
