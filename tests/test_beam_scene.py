"""What a scene may say about beams, and what is refused."""

import tomllib

import pytest

from petfsi.errors import InputError
from petfsi.runs.plan import describe_plan
from petfsi.scene.load import apply_set, dump_scene, scene_from_dict

GATE = """
dim = 2
[time]
end = 1.0
dt = 0.1
[fluid]
density = 1000.0
origin = [0.0, 0.0]
size = [2.0, 1.0]
cells = [32, 16]
[solids.gate]
shape = { beam = { start = [0.5, 0.0], end = [0.5, 0.5], thickness = 0.01, elements = 4 } }
density = 1100.0
young = 1e6
poisson = 0.3
material = "green"
supports = [
    { where = "start", fix = ["x", "angle"], velocity = { angle = "0.1*t" } },
    { where = "bottom", fix = ["y"] },
]
initial = { velocity = [0.0, 0.0, "y"] }
[probes.tip]
of = "gate"
at = [0.5, 0.5]
quantity = "angle"
"""
BOX = "{ box = { origin = [1.0, 0.2], size = [0.2, 0.2], cells = [2, 2] } }"


def gate(*sets):
    data = tomllib.loads(GATE)
    for one in sets:
        apply_set(data, one)
    return data


def beam(start="[1.0, 0.2]", end="[1.0, 0.4]", thickness="0.01", elements="2", more=""):
    return f"{{ beam = {{ start = {start}, end = {end}, thickness = {thickness}, elements = {elements}{more} }} }}"


def other(shape):
    return "solids.other={ shape = " + shape + ", density = 1.0, young = 1.0, poisson = 0.0 }"


def test_a_scene_with_a_beam_is_read_dumped_and_planned():
    scene = scene_from_dict(gate())
    assert scene.solids["gate"].shape.beam.theory == "timoshenko"
    assert scene_from_dict(tomllib.loads(dump_scene(scene))) == scene
    assert "27 unknowns (gate 9 nodes, 4 cells)" in describe_plan(scene)
    hermite = scene_from_dict(gate("solids.gate.shape.beam.theory=euler-bernoulli"))
    assert "15 unknowns (gate 5 nodes, 4 cells)" in describe_plan(hermite)


SHAPE = "solids.gate.shape.beam"
BROKEN = [
    ([f"{SHAPE}.start=[0.5]"], f"{SHAPE}.start = [0.5]", "must have 2 items"),
    ([f"{SHAPE}.end=[0.5, 0.0]"], f"{SHAPE}.end = [0.5, 0.0]", "must differ from start"),
    ([f"{SHAPE}.thickness=0.0"], f"{SHAPE}.thickness = 0.0", "must be greater than 0 (m)"),
    ([f"{SHAPE}.thickness=0.5"], f"{SHAPE}.thickness = 0.5", "must be less than the length, 0.5 m"),
    ([f"{SHAPE}.elements=0"], f"{SHAPE}.elements = 0", "must be 1 or more (along the beam)"),
    ([f"{SHAPE}.theory=bernoulli"], f'{SHAPE}.theory = "bernoulli"', "must be 'timoshenko' or 'euler-bernoulli'"),
    ([f"{SHAPE}.start=[0.001, 0.0]", f"{SHAPE}.end=[0.001, 0.5]"], SHAPE, "inside the fluid's grid, 0 to 2 m"),
    (["solids.gate.material=neohookean"], 'solids.gate.material = "neohookean"', "means nothing to a beam"),
    (["solids.gate.tangent=projected"], 'solids.gate.tangent = "projected"', "means nothing to a beam"),
    (["solids.gate.interior=void"], 'solids.gate.interior = "void"', "means nothing to a beam"),
    (["solids.gate.shape.cavity={origin = [0.5, 0.0], size = [0.1, 0.1]}"], "shape.cavity", "meshed box only"),
    (["solids.gate.shape.scale=2.0"], "solids.gate.shape.scale = 2.0", "belongs to a mesh file only"),
    (["solids.gate.initial.velocity=[0.0]"], "solids.gate.initial.velocity = [0.0]", "must have 2 items"),
    (["solids.gate.supports.0.fix=['z']"], "solids.gate.supports.0.fix", "must be out of x, y"),
    (["solids.gate.supports.1.velocity={angle = 1.0}"], "supports.1.velocity.angle", "belongs to fixed axes only"),
    (["solids.gate.supports.0.velocity.angle='q'"], 'supports.0.velocity.angle = "q"', "unknown name 'q'"),
    (["obstacles.post.shape=" + beam()], "obstacles.post.shape.beam", "only a solid can be a beam"),
    ([f"solids.gate.shape={BOX}"], "solids.gate.supports.0.where", "only a beam has a start and an end"),
    ([f"solids.gate.shape={BOX}"], "solids.gate.supports.0.fix", "only a beam has an angle"),
    ([f"solids.gate.shape={BOX}"], "solids.gate.initial.velocity", "must have 2 items"),
    ([f"solids.gate.shape={BOX}"], "probes.tip.quantity", "only a beam has an angle"),
    (["solids.gate.loads=[{ moment = 1.0 }]"], "solids.gate.loads.0.at", "is missing; a force needs it"),
    (["solids.gate.loads=[{ at = [0.5, 0.5], moment = 'q' }]"], 'loads.0.moment = "q"', "unknown name 'q'"),
    (
        ["solids.gate.loads=[{ at = [0.5, 0.5], moment = [1.0] }]"],
        "loads.0.moment",
        "must be a number or an expression",
    ),
    (["solids.gate.loads=[{ where = 'all', moment = 1.0 }]"], "solids.gate.loads.0.where", "a force has at instead"),
    (["solids.gate.loads=[{ at = [0.5], force = [1.0, 0.0] }]"], "solids.gate.loads.0.at", "must have 2 items"),
    (
        [other(BOX).replace("young = 1.0", "young = 1.0, loads = [{ at = [1.0, 0.2], moment = 1.0 }]")],
        "solids.other.loads.0.moment",
        "only a beam feels a moment",
    ),
    (["probes.tip.of=fluid"], "probes.tip.quantity", "a fluid has velocity, pressure and smoke"),
    (["probes.tip.quantity=smoke"], "probes.tip.quantity", "a solid has displacement and velocity, a beam an angle"),
    (
        ["fluid.sides.left={inflow = {speed = 1.0, rest = 'open', region = " + beam() + "}}"],
        "region.beam",
        "only a sol",
    ),
]


@pytest.mark.parametrize("sets, key, allowed", BROKEN, ids=lambda value: value[0] if isinstance(value, list) else "")
def test_a_mistake_is_named_with_its_key_and_what_is_allowed(sets, key, allowed):
    with pytest.raises(InputError) as caught:
        scene_from_dict(gate(*sets))
    lines = str(caught.value).splitlines()[1:]
    found = [line for line in lines if key in line and allowed in line]
    assert len(found) == 1, caught.value


@pytest.mark.parametrize("shape", [BOX, beam(more=", theory = 'euler-bernoulli'")], ids=["block", "another theory"])
def test_a_scene_may_have_several_kinds_of_solids(shape):
    assert "(gate 9 nodes, 4 cells; other " in describe_plan(scene_from_dict(gate(other(shape))))


def test_a_beam_needs_a_plane():
    data = gate("dim=3")
    del data["fluid"], data["probes"]
    with pytest.raises(InputError, match=r"solids.gate.shape.beam: a beam needs dim = 2"):
        scene_from_dict(data)


@pytest.mark.parametrize(
    "sets, said",
    [
        (["solids.gate.supports.0.where={ box = { origin = [0.6, 0.0], size = [0.1, 0.1] } }"], "no node of the solid"),
        (
            ["obstacles.post={ shape = { box = { origin = [0.4, 0.3], size = [0.2, 0.1] } } }"],
            "overlaps obstacles.post",
        ),
        ([other(beam("[0.5, 0.2]", "[0.5, 0.4]"))], "solids.other.shape: overlaps solids.gate"),
    ],
)
def test_beams_stand_where_there_is_room(sets, said):
    with pytest.raises(InputError, match=said):
        describe_plan(scene_from_dict(gate(*sets)))


def test_a_clamped_end_may_stand_in_a_wall():
    clamp = "solids.gate.supports=[{ where = 'start', fix = ['x', 'y', 'angle'] }]"
    wall = "obstacles.floor={ shape = { box = { origin = [0.0, 0.0], size = [2.0, 0.05] } } }"
    describe_plan(scene_from_dict(gate(clamp, wall)))
    hinge = "solids.gate.supports=[{ where = 'start', fix = ['x', 'y'] }]"
    with pytest.raises(InputError, match="overlaps obstacles.floor"):
        describe_plan(scene_from_dict(gate(hinge, wall)))
