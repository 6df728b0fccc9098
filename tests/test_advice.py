"""What failures advise: it exists, the scene can follow it, and it helps."""

import ast
import re
from pathlib import Path

import pytest
from step_cases import prepared
from test_notes import bar, scene, water

from petfsi.scene.fluids import MacFluid, SphFluid
from petfsi.scene.load import scene_from_dict
from petfsi.scene.schema import Checkpoint, Coupling, Output, Time
from petfsi.solving import options

ROOT = Path(__file__).parents[1]


def texts():
    """Yield every text in petfsi that is no docstring, with the file that it stands in."""
    for path in sorted((ROOT / "petfsi").rglob("*.py")):
        tree = ast.parse(path.read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield path.name, node.value


KEYS = re.compile(r"\b(time|fluid|output|checkpoint|coupling)\.([a-z_]+)\b(?!\.|\()")
TABLES = {
    "time": Time, "output": Output, "checkpoint": Checkpoint, "coupling": Coupling, "fluid": (MacFluid, SphFluid),
}  # fmt: skip
#: What looks like a key.
NOT_KEYS = {"fluid.xdmf", "fluid.py", "output.txt"}


def test_every_key_that_a_message_names_is_one():
    found = [(where, *match.groups()) for where, text in texts() for match in KEYS.finditer(text)]
    assert len(found) > 30
    for where, table, key in found:
        models = TABLES[table] if isinstance(TABLES[table], tuple) else (TABLES[table],)
        known = {name for model in models for name in model.model_fields}
        assert key in known or f"{table}.{key}" in NOT_KEYS, f"{where}: {table}.{key}"


def test_every_options_file_that_a_message_names_is_there():
    shipped = {path.name for path in options.shipped_options()}
    named = {name for _, text in texts() for name in re.findall(r"\b[a-z][a-z-]*\.opts\b", text)}
    assert named - {"options.opts"} <= shipped and {"monolithic.opts", "split-iterated.opts"} <= named


ADVICE = {
    "midpoint": ({"integrator": "midpoint"}, {}, 'newtonls, more damping or time.integrator = "bdf2".'),
    "bdf2": ({}, {}, "Try a smaller dt, -fsi_snes_type newtonls or more damping."),
    "linear": ({}, {"material": "linear"}, "Try a smaller dt or more damping."),
    "explicit": ({"integrator": "symplectic-euler", "dt": 1e-4}, {}, "Try a smaller dt or more damping."),
    "static": ({"integrator": "static"}, {}, "Try smaller steps of the load, by a smaller dt."),
}  # fmt: skip


@pytest.mark.parametrize(("steps", "solid", "said"), ADVICE.values(), ids=ADVICE)
def test_what_may_help_is_what_the_scene_can_do(steps, solid, said):
    with prepared(scene(bar((4, 1), (1.0, 0.2)) | solid, time=steps)) as sim:
        assert said in sim._advice()


def test_water_alone_has_no_damping_to_try():
    with prepared(scene(None, water((4, 4)))) as sim:
        assert sim._advice() == "Try a smaller dt."


@pytest.mark.parametrize("helped", [{"dt": 0.005}, {"integrator": "bdf2"}, {"damping": {"stiffness": 1e-3}}])
def test_what_is_advised_against_energy_out_of_nothing_helps(helped):
    """Of a stiff disk that the midpoint rule turns: without help it stops after 42 steps."""
    shape = {"ball": {"centre": [0.0, 0.0], "radius": 0.2, "cells": 6}}
    disk = {"shape": shape, "density": 1000.0, "young": 1e7, "poisson": 0.3}
    disk |= {"initial": {"velocity": ["-13*y", "13*x"]}, "damping": helped.get("damping", {})}
    steps = {"end": 2.0, "dt": 0.01, "integrator": "midpoint"} | {k: v for k, v in helped.items() if k != "damping"}
    with prepared(scene_from_dict({"dim": 2, "time": steps, "solids": {"disk": disk}})) as sim:
        for _ in range(80):
            sim.advance()
