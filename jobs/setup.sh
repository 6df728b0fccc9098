#!/usr/bin/env bash
# Set petfsi up on Debian 12 (or a machine laid out like it): PETSc, MPI and parallel HDF5 from the
# distribution, everything else in .venv. Safe to run again: what is there already is left alone.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

packages="python3-venv python3-petsc4py-real python3-mpi4py python3-h5py-mpi python3-scipy openmpi-bin"

as_root() { if [ "$(id -u)" = 0 ]; then "$@"; else sudo "$@"; fi; }

missing=""
for package in $packages; do
    [ "$(dpkg-query -W -f '${db:Status-Status}' "$package" 2>/dev/null || true)" = installed ] || missing="$missing $package"
done
if [ -n "$missing" ]; then
    echo "setup: installing$missing"
    export DEBIAN_FRONTEND=noninteractive
    as_root apt-get update -qq
    # shellcheck disable=SC2086
    as_root apt-get install -y -qq --no-install-recommends $missing > /dev/null
fi

[ -x .venv/bin/python ] || /usr/bin/python3 -m venv --system-site-packages .venv

# Debian keeps petsc4py under the PETSc directory, where only the -dev package's link would find it.
site=$(.venv/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
if ! .venv/bin/python -c 'import petsc4py' 2>/dev/null; then
    petsc=$(ls -d /usr/lib/petscdir/petsc3*/*-real/lib/python3/dist-packages 2>/dev/null | sort -V | tail -n 1)
    [ -n "$petsc" ] || { echo "setup: petsc4py was not found under /usr/lib/petscdir" >&2; exit 1; }
    echo "$petsc" > "$site/debian-petsc.pth"
fi

# The three MPI packages come from Debian: pip must not lay serial wheels over them, so petfsi itself is
# installed without its dependencies, and those that are pure or harmless come first.
stamp="$site/.petfsi-setup"
wanted=$(sha256sum pyproject.toml jobs/setup.sh | sha256sum | cut -d' ' -f1)
if [ "$(cat "$stamp" 2>/dev/null || true)" != "$wanted" ]; then
    echo "setup: installing Python packages into .venv"
    .venv/bin/python - <<'PY' > .venv/requirements.txt
import tomllib
project = tomllib.load(open("pyproject.toml", "rb"))["project"]
from_debian = ("petsc4py", "mpi4py", "h5py", "scipy")
wanted = project["dependencies"] + project["optional-dependencies"]["test"]
print("\n".join(w for w in wanted if not w.startswith(from_debian)))
PY
    .venv/bin/python -m pip install --quiet --disable-pip-version-check wheel -r .venv/requirements.txt
    .venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
    echo "$wanted" > "$stamp"
fi

# Numba looks at a compiled function's own file alone: where a function that it calls has changed, it would go on with
# the old one.
kernels="$site/.petfsi-kernels"
now=$(grep -rlE --include='*.py' 'njit|compiled_for' petfsi | LC_ALL=C sort | xargs sha256sum | sha256sum | cut -d' ' -f1)
if [ "$(cat "$kernels" 2>/dev/null || true)" != "$now" ]; then
    find petfsi -name '*.nb[ci]' -delete
    echo "$now" > "$kernels"
fi
echo "setup: ready ($(.venv/bin/petfsi --version))"
