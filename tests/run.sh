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

# ranks that share cores spin while they wait; yielding lets the others work
export OMPI_MCA_mpi_yield_when_idle=1
# many processes are started: each module is compiled once
unset PYTHONDONTWRITEBYTECODE
bash tests/compile.sh
# a process per core; who has nothing left takes tests from the others (5: of those asked for none is there)
for third in 0 1 2; do # what was compiled and imported stays: new processes for each third take less memory
    PETFSI_THIRD=$third .venv/bin/python -m pytest -q -n auto --dist worksteal --durations=6 -m "not launches" "$@" ||
        [ $? = 5 ]
done
echo "== processes of several ranks"
.venv/bin/python -m pytest -q --durations=5 -m launches "$@" || [ $? = 5 ]
for ranks in 2 3 4; do
    echo "== $ranks ranks"
    # all ranks say the same: rank 0's last line is enough, unless a test fails on one of them and the others wait
    rm -rf "build/ranks-$ranks"
    timeout 900 mpiexec -n "$ranks" --oversubscribe --output-filename "build/ranks-$ranks" \
        .venv/bin/python -m pytest -q -x --color=no "$@" > /dev/null 2>&1 || {
        tail -n 60 "build/ranks-$ranks"/*/rank.*/stdout
        echo "the tests on $ranks ranks failed" >&2
        exit 1
    }
    tail -n 1 "build/ranks-$ranks"/*/rank.0/stdout
done
