#!/usr/bin/env bash
# Set up and run every check: lint, types, tests on 1, 2, 3 and 4 ranks. PETFSI_SLOW=1 adds the long validations.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bash jobs/setup.sh
# shellcheck source=jobs/environment.sh
. jobs/environment.sh

.venv/bin/ruff check petfsi tests
.venv/bin/ruff format --check petfsi tests
.venv/bin/mypy petfsi

.venv/bin/python -m pytest -q --durations=10 "$@"
for ranks in 2 3 4; do
    echo "== $ranks ranks"
    # the ranks say the same thing: the first one's voice is enough unless it fails
    mpiexec -n "$ranks" --oversubscribe --output-filename build/ranks-$ranks .venv/bin/python -m pytest -q -x "$@" > /dev/null 2>&1 || {
        cat build/ranks-$ranks/*/rank.*/stdout
        exit 1
    }
    tail -n 1 build/ranks-$ranks/*/rank.0/stdout
done
