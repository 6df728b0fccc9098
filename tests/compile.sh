#!/usr/bin/env bash
# Compile what tests run, once, on two cores: else every test process that needs a kernel first compiles its own.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
[ -z "$(find petfsi -name '*.nbi' -print -quit)" ] || exit 0
out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT
step() {
    local scene=$1
    shift
    .venv/bin/petfsi run "$scene" --steps 2 --out "$out/$(basename "$scene").$BASHPID.$RANDOM" "$@" > "$out/log.$BASHPID" ||
        { cat "$out/log.$BASHPID" >&2 && return 1; }
}
solid_in_3d() {
    step jobs/bar.toml --set "fluid.cells=[12, 8, 8]"
    step jobs/added-mass-ball.toml --set "fluid.cells=[8, 8, 8]" --set solids.ball.shape.ball.cells=4
}
the_rest() {
    step jobs/gate.toml
    step jobs/dambreak.toml --set fluid.spacing=0.01
    step jobs/column.toml
    step jobs/neohookean.toml
    step jobs/cavity.toml
}
solid_in_3d & three=$!
the_rest & two=$!
wait "$three" "$two"
