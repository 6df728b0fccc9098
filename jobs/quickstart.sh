#!/usr/bin/env bash
# Set petfsi up, run the bar in the jet, draw it, and say where everything is.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bash jobs/setup.sh
# shellcheck source=jobs/environment.sh
. jobs/environment.sh
.venv/bin/petfsi run jobs/bar.toml --out runs/bar --overwrite
.venv/bin/petfsi plot runs/bar
echo
echo "The bar in the jet:   runs/bar/pictures/ (the last ones show it bent), history.png beside them"
echo "Numbers:              runs/bar/history.csv, runs/bar/summary.json"
echo "For ParaView:         runs/bar/fields.xdmf"
