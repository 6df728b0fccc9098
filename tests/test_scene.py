import copy
import pickle
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from petfsi.errors import InputError
from petfsi.scene.changes import RESUMABLE
from petfsi.scene.checks import RESERVED_PROBES, check_inside_grid, expressions
from petfsi.scene.load import apply_set, dump_scene, load_scene, parse_value, scene_from_dict
from petfsi.scene.mistakes import unknown
from petfsi.scene.schema import Scene
from petfsi.scene.stepping import Stepping

LAYER = """
title = "An elastic \\"layer\\" under water, \\u00b0C \\\\ \\u007f"
dim = 2
gravity = [0.0, "-9.81*min(t, 1)"]

[time]
end = 2.0
dt = 0.01

[fluid]
density = 1000.0
origin = [0.0, 0.0]
size = [1.0, 2.0]
cells = [32, 64]
smoke = { initial = "x", buoyancy = 0.5 }
[fluid.sides]
top = "open"
right = { inflow = { speed = "1 - y", region = { ball = { centre = [1.0, 1.0], radius = 0.1 } }, smoke = 1.0 } }

[solids.layer]
shape = { box = { origin = [0.0, 0.0], size = [1.0, 0.5], cells = [16, 8] } }
density = 1200
young = 1.0e5
poisson = 0.3
supports = [
    { where = "bottom", fix = ["x", "y"], velocity = { x = "sin(t)" } },
    { where = { box = { origin = [0.0, 0.0], size = [0.1, 0.5] } }, fix = ["x"] },
]
[solids.layer.initial]
velocity = ["0.0", "1e-3*sin(pi*y)"]

[obstacles.floor]
shape = { halfspace = { point = [0.0, 0.0], normal = [0.0, 1.0] } }

[probes.top]
of = "layer"
at = [0.5, 0.5]
quantity = "displacement"

[probes.gauge]
of = "fluid"
at = [0.5, 1.5]
quantity = "smoke"

[output]
every = 0.05
"""

BALLOON = """
dim = 3
[time]
end = 1.0
dt = 0.1
[fluid]
density = 1.0
origin = [0.0, 0.0, 0.0]
size = [1.0, 1.0, 1.0]
cells = [8, 8, 8]
[fluid.sides]
back = "periodic"
front = "periodic"
[solids.shell]
density = 1000.0
young = 1e4
poisson = 0.4
interior = "void"
[solids.shell.shape.box]
origin = [0.2, 0.2, 0.2]
size = [0.6, 0.6, 0.6]
cells = [6, 6, 6]
[solids.shell.shape.cavity]
origin = [0.3, 0.3, 0.3]
size = [0.4, 0.4, 0.4]
[obstacles.pipe]
shape = { cylinder = { start = [0.0, 0.0, 0.0], end = [1.0, 0.0, 0.0], radius = 0.05 } }
outside = true
"""


def layer(*sets: str) -> dict:
    data = tomllib.loads(LAYER)
    for setting in sets:
        apply_set(data, setting)
    return data


def balloon(*sets: str) -> dict:
    data = tomllib.loads(BALLOON)
    for setting in sets:
        apply_set(data, setting)
    return data


def mistakes(data: dict, directory: Path | str = ".") -> list[str]:
    """Return the lines of the report, without its heading."""
    with pytest.raises(InputError) as caught:
        scene_from_dict(data, directory)
    assert caught.value.exit_code == 2
    heading, *lines = str(caught.value).splitlines()
    assert heading == ("scene: one mistake" if len(lines) == 1 else f"scene: {len(lines)} mistakes")
    return [line.removeprefix("  ") for line in lines]


def without(data: dict, *keys: str) -> dict:
    for key in keys:
        *tables, name = key.split(".")
        table = data
        for part in tables:
            table = table[part]
        del table[name]
    return data


BOX = "{ origin = [0.0, 0.0], size = [1.0, 1.0] }"

#: A disk that reaches 5 cm into the layer.
STONE = "{shape = {ball = {centre = [0.5, 0.55], radius = 0.1, cells = 4}}, density = 1.0, young = 1.0, poisson = 0.0}"


def ball(settings: str) -> str:
    """Return the setting that makes the layer a disk."""
    return f"solids.layer.shape={{ball = {{{settings}}}}}"


def load(settings: str) -> str:
    """Return the setting that gives the layer one load."""
    return f"solids.layer.loads=[{{{settings}}}]"


#: Settings laid over a sound scene, the key that is wrong then, and words of what is allowed.
BROKEN = [
    # one value at a time
    (["dim=4"], "dim = 4", "must be 2 or 3"),
    (["dim=true"], "dim = true", "must be 2 or 3"),
    (["time.dt=0"], "time.dt = 0", "must be greater than 0 (s)"),
    (["time.dt=nan"], "time.dt = nan", "(s)"),
    (["time.dt=0.1*x"], 'time.dt = "0.1*x"', "unknown name 'x'; known are t, pi, e"),
    (["time.dt=0.1 - 0.1"], 'time.dt = "0.1 - 0.1"', "must be greater than 0 (s)"),
    (["time.dt=t"], 'time.dt = "t"', "is 0 at t = 0; must be greater than 0 (s)"),
    (["time.dt=1/t"], 'time.dt = "1/t"', "is inf at t = 0; it must be finite"),
    (["time.dt=3 + t"], 'time.dt = "3 + t"', "must not exceed time.end = 2 s"),
    (["time.dt=[1]"], "time.dt = [1]", "must be a number or an expression in quotes (s)"),
    (["time.end='2'"], 'time.end = "2"', "must be a number (s)"),
    (["time.integrator=bdf9"], 'time.integrator = "bdf9"', "must be 'newmark'"),
    (["fluid=3"], "fluid = 3", "must be a table"),
    (["fluid.density=-1"], "fluid.density = -1", "must be greater than 0 (kg/m^3)"),
    (["fluid.density=true"], "fluid.density = true", "must be a number (kg/m^3)"),
    (["fluid.viscosity=0.1"], "fluid.viscosity = 0.1", "must be 0: this version solves inviscid fluids"),
    (["fluid.kind=lbm"], 'fluid.kind = "lbm"', "must be 'mac'"),
    (["fluid.cells=[32, 0]"], "fluid.cells.1 = 0", "must be 1 or more"),
    (["fluid.cells=[32, 6.5]"], "fluid.cells.1 = 6.5", "must be a whole number"),
    (["fluid.cells=64"], "fluid.cells = 64", "must be a list"),
    (["fluid.origin=['a', 0.0]"], 'fluid.origin.0 = "a"', "must be a number"),
    (["fluid.sides.top=opn"], 'fluid.sides.top = "opn"', "must be 'slip', 'open', 'hydrostatic' or 'periodic' (or"),
    (["fluid.sides.top={}"], "fluid.sides.top", "or a table of one of inflow, pressure and hydrostatic"),
    (["fluid.sides.right.inflow.rest=shut"], 'inflow.rest = "shut"', "must be 'slip', 'open' or 'hydrostatic'"),
    (["fluid.sides.right.inflow.ramp=-1"], "fluid.sides.right.inflow.ramp = -1", "must be 0 or more (s"),
    (["solids.layer.poisson=0.5"], "solids.layer.poisson = 0.5", "must be less than 0.5"),
    (["solids.layer.young=0"], "solids.layer.young = 0", "must be greater than 0 (Pa)"),
    (
        ["solids.layer.material=jelly"],
        'material = "jelly"',
        "must be 'green', 'neohookean', 'stable-neohookean' or 'linear'",
    ),
    (
        ["solids.layer.elements=cubic"],
        'elements = "cubic"',
        "must be 'linear' or 'quadratic' (order of the shape functions)",
    ),
    (
        ["solids.layer.volumetric=half"],
        'volumetric = "half"',
        "must be 'full' or 'reduced' (integration of lambda's part; reduced does not lock)",
    ),
    (["solids.layer.tangent=soft"], 'tangent = "soft"', "must be 'exact' or 'projected' (projected: without"),
    (["solids.layer.interior=air"], 'interior = "air"', "must be 'fluid' or 'void'"),
    (["solids.layer.supports.0.fix=[]"], "solids.layer.supports.0.fix = []", "must not be empty"),
    (["solids.layer.supports.1.fix=['w']"], "solids.layer.supports.1.fix.0", "must be 'x', 'y', 'z' or 'angle'"),
    (
        ["solids.layer.supports.0.velocity={w = 1.0}"],
        "solids.layer.supports.0.velocity.w",
        "must be 'x', 'y', 'z' or 'angle'",
    ),
    (
        ["solids.layer.supports.0.where=under"],
        'where = "under"',
        "'front', 'all', 'start' or 'end' (or a shape",
    ),
    (["obstacles.floor.outside='yes'"], 'obstacles.floor.outside = "yes"', "must be true or false"),
    (["probes.top.quantity=stress"], 'probes.top.quantity = "stress"', "'velocity', 'angle', 'pressure', "),
    (["time.above_limit=ignore"], 'time.above_limit = "ignore"', "must be 'refuse' or 'subcycle'"),
    (["time.retries=-1"], "time.retries = -1", "must be 0 or more"),
    (["time.energy_limit=-2"], "time.energy_limit = -2", "must be 0 or more, or -1"),
    (["time.retries=21"], "time.retries = 21", "must be 20 or less"),
    (["time.integrator=static", "solids.layer.initial={}"], 'time.integrator = "static"', "take out the [fluid]"),
    (["checkpoint.keep=0"], "checkpoint.keep = 0", "must be 1 or more"),
    (["output.every=-1"], "output.every = -1", "must be greater than 0 (s)"),
    (["coupling.transfer=magic"], 'coupling.transfer = "magic"', "must be 'cutcell', 'ray', 'pressure' or 'repulsion'"),
    (["coupling.quadrature=9"], "coupling.quadrature = 9", "must be 4 or less"),
    (["title=3"], "title = 3", "must be a text in quotes"),
    (["gravity.0=true"], "gravity.0 = true", "must be a number or an expression in quotes (m/s^2"),
    (["gravity.0=inf"], "gravity.0 = inf", "must be a finite number"),
    (["gravity.0=2020-01-01"], "gravity.0", "must be a number or an expression"),
    # unknown keys
    (["fluid.viscocity=0"], "fluid.viscocity = 0", "no setting 'viscocity'; did you mean 'viscosity' (Pa s)?"),
    (["outptu.every=1.0"], "outptu", "no setting 'outptu'; did you mean 'output'?"),
    (["solids.layer.youngs=1.0"], "solids.layer.youngs = 1.0", "did you mean 'young' (Pa)?"),
    (["solids.layer.shape.box.cell=[1]"], "solids.layer.shape.box.cell", "did you mean 'cells'?"),
    (["fluid.gravity=[0.0]"], "fluid.gravity", "it stands at the top of the scene"),
    (["fluid.dt=0.1"], "fluid.dt = 0.1", "did you mean 'time.dt'?"),
    (["fluid.sides.right.inflow.poisson=0.3"], "poisson = 0.3", "did you mean 'solids.NAME.poisson'?"),
    (["output.qqq=1"], "output.qqq = 1", "known here are every"),
    # lengths and sizes
    (["gravity=[0.0]"], "gravity = [0.0]", "must have 2 items, as dim = 2"),
    (["fluid.size=[1.0, 2.0, 3.0]"], "fluid.size = [1.0, 2.0, 3.0]", "must have 2 items"),
    (["fluid.size=[1.0, 0.0]"], "fluid.size = [1.0, 0.0]", "must be greater than 0 along every axis (m)"),
    (["fluid.cells=[8]"], "fluid.cells = [8]", "must have 2 items"),
    (["fluid.cells=[100000, 100000]"], "fluid.cells", "make more than 2147483647 cells"),
    (["fluid.initial.velocity=[0.0]"], "fluid.initial.velocity = [0.0]", "must have 2 items"),
    (["solids.layer.initial.velocity=[0.0]"], "solids.layer.initial.velocity = [0.0]", "must have 2 items"),
    (["solids.layer.shape.box.size=[1.0, -0.5]"], "solids.layer.shape.box.size", "greater than 0 along every axis"),
    (["probes.top.at=[0.5]"], "probes.top.at = [0.5]", "must have 2 items"),
    # time
    (["time.dt=3.0"], "time.dt = 3.0", "must not exceed time.end = 2 s"),
    (["time.dt=2.000001"], "time.dt = 2.000001", "must not exceed time.end = 2 s"),
    (["time.dt=1e-10"], "time.dt = 1e-10", "makes 2e+10 steps"),
    (["time.dt=1e-320"], "time.dt", "steps to time.end = 2 s; at most 1e+08 may be"),
    # sides
    (["fluid.sides.left=periodic"], 'fluid.sides.left = "periodic"', "the opposite side 'right' must be periodic too"),
    (["fluid.sides.bottom=periodic"], "fluid.sides.bottom", "the opposite side 'top' must be periodic too"),
    (["fluid.sides.back=slip"], "fluid.sides.back", "bounds z, which dim = 2 does not have"),
    (["fluid.sides.right.inflow.region={mesh='a.stl'}"], "inflow.region.mesh", "must be a box, ball, cylinder or half"),
    (["fluid.sides.right.inflow.speed='-q'"], 'inflow.speed = "-q"', "unknown name 'q'; known are x, y, t, pi, e"),
    # shapes
    (["solids.layer.shape={}"], "solids.layer.shape", "must have exactly one of box, ball, cylinder"),
    (["solids.layer.shape.mesh='a.msh'"], 'solids.layer.shape = "box, mesh"', "must have exactly one of"),
    ([f"solids.layer.shape.box={BOX}"], "solids.layer.shape.box.cells", "is missing; a solid's box needs"),
    (["solids.layer.shape={halfspace = {point = [0.0, 0.0], normal = [0.0, 1.0]}}"], "halfspace", "must be meshed"),
    ([ball("centre = [0.5, 0.5], radius = 0.1")], "layer.shape.ball.cells", "is missing; a solid's ball needs its"),
    ([ball("centre = [0.5, 0.5], radius = 0.1, cells = 7")], "shape.ball.cells = 7", "a multiple of 2 (cells across)"),
    ([ball("centre = [0.5, 0.5], radius = 0.1, cells = 0")], "shape.ball.cells = 0", "must be 2 or more"),
    (
        [ball("centre = [0.5, 0.5], radius = 0.1, cells = [8, 8]")],
        "shape.ball.cells = [8, 8]",
        "must be a whole number",
    ),
    ([ball("centre = [0.5, 0.5], radius = 0.1, cells = 50000")], "ball.cells = 50000", "make more than 2147483647"),
    ([ball("centre = [0.5, 0.5], radius = 0.0, cells = 8")], "shape.ball.radius = 0.0", "must be greater than 0"),
    ([ball("centre = [0.5], radius = 0.1, cells = 8")], "shape.ball.centre = [0.5]", "must have 2 items"),
    (
        [ball("centre = [0.9, 0.5], radius = 0.2, cells = 8")],
        'shape.ball = "x from 0.7 to 1.1 m"',
        "inside the fluid's",
    ),
    (
        [ball("centre = [0.5, 0.5], radius = 0.1, cells = 8"), f"solids.layer.shape.cavity={BOX}"],
        "solids.layer.shape.cavity",
        "belongs to a meshed box only",
    ),
    ([f"solids.two={STONE}"], "solids.two.shape.ball", "overlaps solids.layer; bodies must lie apart"),
    (
        [f"solids.two={STONE}", ball("centre = [0.5, 0.8], radius = 0.21, cells = 8")],
        "solids.two.shape.ball",
        "overlaps solids.layer; bodies must lie apart",
    ),
    (["solids.layer.shape={mesh='missing.msh'}"], "solids.layer.shape.mesh", "no such file"),
    (["solids.layer.shape.scale=2.0"], "solids.layer.shape.scale = 2.0", "belongs to a mesh file only"),
    (["solids.layer.shape.translate=[0.0, 0.0]"], "solids.layer.shape.translate", "belongs to a mesh file only"),
    (
        ["solids.layer.shape.box.origin=[0.5, 0.0]"],
        'shape.box = "x from 0.5 to 1.5 m"',
        "inside the fluid's grid, 0 to 1",
    ),
    (
        [
            "solids.two={shape = {box = {origin = [0.5, 0.2], size = [0.1, 0.1], cells = [2, 2]}}, density = 1.0, "
            "young = 1.0, poisson = 0.0}"
        ],
        "solids.two.shape.box",
        "overlaps solids.layer; bodies must lie apart",
    ),
    (["obstacles.floor.shape.halfspace.normal=[0.0, 0.0]"], "halfspace.normal = [0.0, 0.0]", "must not be zero"),
    (
        ["obstacles.floor.shape={cylinder = {start = [0.0, 0.0], end = [1.0, 0.0], radius = 0.1}}"],
        "obstacles.floor.shape.cylinder",
        "a cylinder needs dim = 3; in 2D use ball",
    ),
    (
        ["obstacles.floor.shape={box = {origin = [0.0, 0.0], size = [1.0, 1.0], cells = [2, 2]}}"],
        "obstacles.floor.shape.box.cells = [2, 2]",
        "only a solid's box is meshed",
    ),
    (
        ["obstacles.floor.shape={ball = {centre = [0.0, 0.0], radius = 0.1, cells = 8}}"],
        "obstacles.floor.shape.ball.cells = 8",
        "only a solid's ball is meshed; leave cells out",
    ),
    (
        ["fluid.sides.right.inflow.region.ball.cells=8"],
        "fluid.sides.right.inflow.region.ball.cells = 8",
        "only a solid's ball is meshed",
    ),
    (
        ["fluid.sides.bottom=periodic", "fluid.sides.top=periodic"],
        "obstacles.floor.shape.halfspace.normal = [0.0, 1.0]",
        "must not lean along y, whose sides are periodic",
    ),
    ([f"obstacles.floor.shape.cavity={BOX}"], "obstacles.floor.shape.cavity", "only a solid's box can have a cavity"),
    (["obstacles.floor.shape={mesh='missing.stl'}"], "obstacles.floor.shape.mesh", "no such file"),
    (
        ["solids.layer.shape.cavity={origin = [0.0, 0.0], size = [0.01, 0.01]}"],
        "solids.layer.shape.cavity",
        "holds no cell's centre",
    ),
    ([f"solids.layer.shape.cavity={BOX}"], "solids.layer.shape.cavity", "holds every cell's centre"),
    # supports
    (["solids.layer.supports.0.fix=['x', 'z']", "solids.layer.supports.0.where=top"], "supports.0.fix", "out of x, y"),
    (["solids.layer.supports.0.fix=['x', 'x']"], "solids.layer.supports.0.fix", "names an axis twice"),
    (["solids.layer.supports.0.where=front"], "solids.layer.supports.0.where", "bounds z"),
    (
        ["solids.layer.supports.1.velocity.y=1.0"],
        "supports.1.velocity.y = 1.0",
        "belongs to fixed axes only; fix = ['x']",
    ),
    (["solids.layer.supports.0.where={mesh='a.stl'}"], "supports.0.where.mesh", "must be a box, ball"),
    (["solids.layer.supports.0.where={tag='foot'}"], 'where.tag = "foot"', "a tag is a mesh file's, and the solid's"),
    (
        ["solids.layer.supports.0.where={tag=true}"],
        "supports.0.where.tag = true",
        "must be a text in quotes (the name of a",
    ),
    (["solids.layer.supports.0.where={tag=''}"], 'supports.0.where.tag = ""', "must not be empty"),
    (
        ["solids.layer.supports.0.displacement={x = 1.0}"],
        "displacement.x = 1.0",
        "the axis has a velocity too; give one",
    ),
    (
        ["solids.layer.supports.1.displacement={y = 1.0}"],
        "displacement.y = 1.0",
        "a displacement belongs to fixed axes",
    ),
    (
        ["solids.layer.supports.0.displacement={w = 1.0}"],
        "supports.0.displacement.w",
        "must be 'x', 'y', 'z' or 'angle'",
    ),
    (["solids.layer.supports.1.displacement={x = 'q'}"], 'displacement.x = "q"', "unknown name 'q'"),
    # loads
    (["solids.layer.body_force=[1.0]"], "solids.layer.body_force = [1.0]", "must have 2 items"),
    (["solids.layer.body_force=[1.0, 'z']"], 'solids.layer.body_force.1 = "z"', "known are x, y, t, pi, e"),
    (
        ["solids.layer.body_force=[true, 1.0]"],
        "body_force.0 = true",
        "must be a number or an expression in quotes (N/m^3",
    ),
    (
        ["solids.layer.loads=[{}]"],
        "solids.layer.loads.0",
        "must have exactly one of traction, pressure (both with where)",
    ),
    (
        [load("where = 'top', pressure = 1.0, traction = [0.0, 1.0]")],
        'loads.0 = "traction, pressure"',
        "exactly one of",
    ),
    ([load("where = 'top'")], "solids.layer.loads.0", "must have exactly one of traction, pressure"),
    ([load("pressure = 1.0")], "solids.layer.loads.0.where", "is missing; a pressure needs it"),
    ([load("at = [0.5, 0.5], where = 'top', force = [1.0, 1.0]")], "loads.0.where", "a force has at instead"),
    ([load("where = 'top', force = [1.0, 1.0]")], "loads.0.where", "a force has at instead"),
    ([load("force = [1.0, 1.0]")], "loads.0.at", "is missing; a force needs it"),
    ([load("where = 'top', pressure = 'q'")], 'loads.0.pressure = "q"', "unknown name 'q'"),
    ([load("where = 'top', pressure = inf")], "loads.0.pressure = inf", "must be a finite number (Pa"),
    ([load("where = 'top', traction = [1.0]")], "loads.0.traction = [1.0]", "must have 2 items"),
    ([load("where = 'top', traction = [1.0, 'z']")], 'loads.0.traction.1 = "z"', "known are x, y, t, pi, e"),
    (
        [load("where = 'top', pressure = 1.0, follower = 1")],
        "loads.0.follower = 1",
        "must be true or false (whether it",
    ),
    ([load("at = [0.5, 0.5], force = [1.0, 1.0], follower = true")], "loads.0.follower = true", "keeps its direction"),
    ([load("at = [0.5], force = [1.0, 1.0]")], "loads.0.at = [0.5]", "must have 2 items"),
    ([load("at = [0.5, 0.5], force = [1.0]")], "loads.0.force = [1.0]", "must have 2 items"),
    ([load("at = [0.5, 0.5], force = [1.0, 'x*']")], 'loads.0.force.1 = "x*"', "is not an expression"),
    ([load("where = 'front', pressure = 1.0")], 'loads.0.where = "front"', "bounds z, which dim = 2 does not have"),
    (
        [load("where = 'under', pressure = 1.0")],
        'loads.0.where = "under"',
        "'front', 'all', 'start' or 'end' (or a shape such as",
    ),
    ([load("where = { tag = 'lid' }, pressure = 1.0")], 'loads.0.where.tag = "lid"', "a tag is a mesh file's"),
    ([load("where = { mesh = 'a.stl' }, pressure = 1.0")], "loads.0.where.mesh", "must be a box, ball, cylinder or"),
    (
        ["probes.load_work={of='fluid', at=[0.5, 1.0], quantity='pressure'}"],
        "probes.load_work",
        "is a column of history",
    ),
    # names and probes
    (["probes.9a={of='fluid', at=[0.5, 1.0], quantity='pressure'}"], "probes.9a", "a name must be made of letters"),
    (["solids.a-b=1"], "solids.a-b = 1", "must be a table"),
    (["probes.time={of='fluid', at=[0.5, 1.0], quantity='pressure'}"], "probes.time", "is a column of history.csv"),
    (["probes.top.of=lyer"], 'probes.top.of = "lyer"', "must be one of fluid, layer"),
    (["probes.top.quantity=pressure"], 'probes.top.quantity = "pressure"', "a solid has displacement and velocity"),
    (["probes.gauge.quantity=displacement"], "probes.gauge.quantity", "a fluid has velocity, pressure and smoke"),
    (["probes.gauge.at=[0.5, 2.5]"], "probes.gauge.at = [0.5, 2.5]", "y must lie inside the fluid's grid, 0 to 2 m"),
    # expressions
    (["gravity.1='9.81*x'"], 'gravity.1 = "9.81*x"', "unknown name 'x'; known are t, pi, e"),
    (["fluid.smoke.initial='t'"], 'fluid.smoke.initial = "t"', "known are x, y, pi, e"),
    (["solids.layer.initial.velocity.1='sin(z)'"], 'initial.velocity.1 = "sin(z)"', "unknown name 'z'"),
    (["solids.layer.supports.0.velocity.x='import os'"], "supports.0.velocity.x", "is not an expression; allowed are"),
]


@pytest.mark.parametrize("sets, key, allowed", BROKEN, ids=lambda value: value[0] if isinstance(value, list) else "")
def test_a_mistake_is_reported_once_with_its_key_its_value_and_what_is_allowed(sets, key, allowed):
    lines = mistakes(layer(*sets))
    assert len(lines) == 1, lines
    assert key in lines[0] and allowed in lines[0], lines[0]


@pytest.mark.parametrize(
    "key, meant",
    [
        ("solids.a.cavity", ["solids.a.shape.cavity"]),
        ("obstacles.a.cavity", ["solids.NAME.shape.cavity"]),
        ("obstacles.a.box", ["obstacles.a.shape.box"]),
        ("solids.a.shape.cavity.box", []),
        ("box", []),
        ("fluid.<mac>.box", []),
        ("fluid.<sph>.box", ["fluid.fill.N.box"]),
        ("solids.a.shape.young", ["solids.a.young"]),
        ("solids.a.shape.yuong", ["solids.a.young"]),
        ("solids.a.shape.thickness", ["solids.a.shape.beam.thickness"]),
        ("fluid.sides.right.speed", ["fluid.sides.right.inflow.speed"]),
        ("fluid.sides.sides", ["fluid.sides"]),
        ("solids.a.loads.2.tag", ["solids.a.loads.2.where.tag"]),
        ("solids.a.tag", ["solids.a.supports.N.where.tag", "solids.a.loads.N.where.tag"]),
        ("time.every", ["output.every", "checkpoint.every"]),
        ("solids.a.yuong", ["young"]),
    ],
)
def test_a_setting_in_a_wrong_place_is_looked_for_near_it_and_not_just_anywhere(key, meant):
    """One or two keys where it can stand, with the names that the scene has; of more none."""
    said = unknown([int(part) if part.isdigit() else part for part in key.split(".")])
    if meant:
        assert f"did you mean {' or '.join(map(repr, meant))}" in said
    else:
        assert f"no setting '{key.split('.')[-1]}'; known here are" in said


@pytest.mark.parametrize("lower", [0.6, 0.61])
def test_a_ball_may_lie_on_another_body(lower):
    stone = STONE.replace("0.55", str(lower))
    assert "two" in scene_from_dict(layer(f"solids.two={stone}")).solids
    disks = layer(f"solids.two={stone}", ball(f"centre = [0.5, {lower - 0.2}], radius = 0.1, cells = 4"))
    assert "two" in scene_from_dict(disks).solids


def test_a_half_space_may_stand_beside_periodic_sides():
    data = layer("fluid.sides.left=periodic", "fluid.sides.right=periodic")
    assert scene_from_dict(data).obstacles["floor"].shape.halfspace is not None
    lines = mistakes({**data, "obstacles": {"floor": {"shape": {"halfspace": {"point": [0, 0], "normal": [0.1, 1]}}}}})
    assert len(lines) == 1 and "must not lean along x, whose sides are periodic" in lines[0]


@pytest.mark.parametrize(
    "data, key, allowed",
    [
        (without(layer(), "time"), "time", "is missing"),
        (without(layer(), "fluid.density"), "fluid.density", "is missing (kg/m^3)"),
        (without(layer(), "fluid.smoke", "probes.gauge"), "fluid.sides.right.inflow.smoke = 1.0", "[fluid.smoke]"),
        (without(layer(), "gravity"), "fluid.smoke.buoyancy = 0.5", "set gravity too"),
        (
            without(layer(), "fluid", "solids", "probes", "obstacles"),
            "fluid",
            "needs a [fluid], or at least one [solids",
        ),
        (without(layer(), "fluid", "probes.gauge"), 'obstacles = "floor"', "only a fluid feels obstacles"),
        (without(layer(), "fluid", "obstacles"), 'probes.gauge.of = "fluid"', "no [fluid], only layer"),
        (
            without(layer("fluid.sides.top=slip", "fluid.sides.right.inflow.speed=0.1"), "solids", "probes.top"),
            "fluid.sides.right.inflow",
            "able to leave",
        ),
        (without(layer("fluid.smoke.buoyancy=0.0", "fluid.sides.right=slip"), "fluid.smoke"), "probes.gauge", "smoke"),
        (balloon("obstacles.pipe.shape.cylinder.end=[0.0, 0.0, 0.0]"), "cylinder.end", "must differ from start"),
        (balloon("solids.shell.shape.box.cells=[6, 6]"), "solids.shell.shape.box.cells", "must have 3 items"),
        (balloon("solids.shell.shape.cavity.cells=[1, 1, 1]"), "cavity.cells", "leave cells out"),
        (balloon("fluid.sides.front=open"), "fluid.sides.back", "the opposite side 'front'"),
        (balloon("solids.shell.shape.box.origin.1=0.5"), "y from 0.5 to 1.1 m", "y must lie inside"),
        (
            balloon("solids.shell.shape.box.size.2=1.1"),
            "solids.shell.shape.box = ",
            "z must be no longer than the grid",
        ),
        (balloon("solids.fluid={}"), "solids.fluid.shape", "is missing"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_what_is_missing_or_does_not_fit_together_is_named(data, key, allowed):
    lines = mistakes(data)
    assert any(key in line and allowed in line for line in lines), lines


def test_a_solid_cannot_be_called_fluid():
    data = layer()
    data["solids"]["fluid"] = data["solids"].pop("layer")
    lines = mistakes(data)
    assert "solids.fluid: the name 'fluid' means the fluid; call the solid something else" in lines


@pytest.mark.parametrize("name", RESERVED_PROBES)
def test_a_probe_cannot_take_a_column_of_the_history(name):
    assert name in mistakes(layer(f"probes.{name}={{of='fluid', at=[0.5, 1.0], quantity='pressure'}}"))[0]


def test_all_mistakes_stand_together_whatever_finds_them():
    lines = mistakes(
        layer(
            "fluid.viscocity=0",
            "time.dt=-1",
            "solids.layer.young=soft",
            "solids.layer.supports.0.velocity.x='sine(t)'",
            "solids.layer.supports.0.fix=['x', 'z']",
            "probes.top.of=lyer",
            "gravity=[0.0]",
        )
    )
    keys = [line.split(" ")[0] for line in lines]
    assert keys == [
        "time.dt",
        "fluid.viscocity",
        "solids.layer.young",
        "solids.layer.supports.0.fix",
        "probes.top.of",
        "gravity",
        "solids.layer.supports.0.velocity.x",
    ]


@pytest.mark.parametrize(
    "sets",
    [
        ["fluid.size=3"],  # whether the layer lies in the grid cannot be said
        ["fluid.origin.1=a"],
        ["solids.layer.shape.box.origin=[0.5, true]"],
        ["probes.top.of=3"],
        ["solids.layer.supports.0.fix=['q']"],
        [ball("centre = [0.5, 0.5], radius = 0.1, cells = true")],
        ["dim=5"],
    ],
)
def test_a_mistake_draws_no_others_after_it(sets):
    assert len(mistakes(layer(*sets))) == 1


def test_a_report_fits_on_a_screen():
    data = layer(*(f"fluid.nonsense{n}=1" for n in range(60)))
    with pytest.raises(InputError) as caught:
        scene_from_dict(data)
    lines = str(caught.value).splitlines()
    assert lines[0] == "scene: 60 mistakes" and lines[-1] == "  and 40 more" and len(lines) == 22
    long = mistakes(layer(f"fluid.advection={'x' * 500}"))[0]
    assert len(long) < 120


VALUES = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=8),
    st.lists(st.floats(), max_size=4),
    st.dictionaries(st.sampled_from(["box", "inflow", "origin", "velocity", "end"]), st.integers(), max_size=2),
)


def leaves(data, path=()):
    yield path
    for key, value in data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ():
        yield from leaves(value, (*path, key))


PATHS = [path for path in leaves(tomllib.loads(LAYER)) if path]


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(PATHS), VALUES), min_size=1, max_size=3))
def test_any_scene_is_read_or_refused_with_input_error(changes):
    data = copy.deepcopy(tomllib.loads(LAYER))
    for path, value in changes:
        table = data
        try:
            for part in path[:-1]:
                table = table[part]
            table[path[-1]] = value
        except (KeyError, IndexError, TypeError):
            continue
    try:
        scene_from_dict(data)
    except InputError as error:
        assert error.exit_code == 2 and "mistake" in str(error)


# ---- reading and writing ------------------------------------------------------------------------------------


def written(folder: Path, text: str = LAYER) -> Path:
    path = folder / "scene.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("text", [LAYER, BALLOON], ids=["2D", "3D"])
def test_a_dumped_scene_is_the_scene(tmp_path, text):
    scene = load_scene(written(tmp_path, text))
    again = load_scene(written(tmp_path, dump_scene(scene)))
    assert again == scene
    assert dump_scene(again) == dump_scene(scene)


def test_a_dumped_scene_names_every_setting():
    data = tomllib.loads(dump_scene(scene_from_dict(layer())))
    assert data["time"]["integrator"] == "bdf2" and data["checkpoint"]["keep"] == 3
    assert data["fluid"]["sides"]["left"] == "slip" and "back" not in data["fluid"]["sides"]
    assert data["solids"]["layer"]["damping"] == {"mass": 0.0, "stiffness": 0.0}
    assert data["solids"]["layer"]["density"] == 1200.0
    assert "scale" not in str(data)


@settings(max_examples=100, deadline=None)
@given(st.text(st.characters(exclude_categories=["Cs"])), st.floats(1e-6, 1e6), st.integers(1, 10**5))
def test_texts_and_numbers_survive_toml(title, density, cells):
    data = layer()
    data["title"], data["fluid"]["density"], data["fluid"]["cells"] = title, density, [cells, 1]
    scene = scene_from_dict(data)
    assert scene_from_dict(tomllib.loads(dump_scene(scene))) == scene


def test_a_mesh_is_found_from_the_scene_and_from_its_copy(tmp_path, monkeypatch):
    folder, elsewhere = tmp_path / "case", tmp_path / "run"
    (folder / "meshes").mkdir(parents=True)
    elsewhere.mkdir()
    mesh = folder / "meshes" / "bunny.msh"
    mesh.write_text("")
    text = LAYER.replace("{ box = { origin = [0.0, 0.0], size = [1.0, 0.5], cells = [16, 8] } }", '{ mesh = "M" }')
    monkeypatch.chdir(tmp_path)
    scene = load_scene(written(folder, text.replace('"M"', '"meshes/bunny.msh"')).relative_to(tmp_path))
    assert scene.directory == Path("case")
    assert scene.solids["layer"].shape.mesh == str(mesh)
    monkeypatch.chdir(elsewhere)
    copied = load_scene(written(elsewhere, dump_scene(scene)))
    assert copied == scene and copied.directory == elsewhere


def test_a_scene_travels_between_ranks(tmp_path):
    scene = load_scene(written(tmp_path))
    again = pickle.loads(pickle.dumps(scene))
    assert again == scene and again.directory == tmp_path


def test_a_change_makes_another_scene():
    assert scene_from_dict(layer()) != scene_from_dict(layer("time.dt=0.02"))
    assert scene_from_dict(layer()) != "scene"


def test_what_one_reads_is_left_as_it_was():
    data = layer()
    before = copy.deepcopy(data)
    with pytest.raises(InputError):
        scene_from_dict({**data, "dim": 9})
    scene_from_dict(data)
    assert data == before


@pytest.mark.parametrize(
    "content, said",
    [
        (b"dim = ", "not valid TOML: Invalid value"),
        (b"\xff\xfe", "is not UTF-8 text (byte 0)"),
        (b"dim = 2\ndim = 3\n", "not valid TOML: Cannot overwrite a value (at line 2"),
        (b"a = " + b"[" * 5000, "nested deeper than 30 levels"),
        (b"", "3 mistakes"),
    ],
)
def test_a_file_that_is_no_scene_is_refused(tmp_path, content, said):
    path = tmp_path / "scene.toml"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        load_scene(path)
    assert str(path) in str(caught.value) and said in str(caught.value)


def test_a_missing_file_and_a_folder_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file; a scene is a TOML file"):
        load_scene(tmp_path / "scene.toml")
    with pytest.raises(InputError, match="is a folder"):
        load_scene(tmp_path)


# ---- --set --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text, value",
    [
        ("1e-3", 1e-3),
        ("7", 7),
        ("true", True),
        ("[1, 2.5]", [1, 2.5]),
        ('"0.5"', "0.5"),
        ("mac", "mac"),
        ("-9.81*t", "-9.81*t"),
        ("{ a = 1 }", {"a": 1}),
        ("", ""),
        ("1\nb = 2", "1\nb = 2"),
    ],
)
def test_a_set_value_is_toml_or_else_text(text, value):
    assert parse_value(text) == value and type(parse_value(text)) is type(value)


def test_set_reaches_every_leaf(tmp_path):
    sets = ["time.dt=0.02", "solids.layer.supports.1.fix.0=y", "gravity.1 = -1", "checkpoint.every=0.5", "title=a=b"]
    scene = load_scene(written(tmp_path), sets)
    assert scene.time.dt == 0.02 and scene.gravity == [0.0, -1.0] and scene.checkpoint.every == 0.5
    assert scene.solids["layer"].supports[1].fix == ["y"] and scene.title == "a=b"


@pytest.mark.parametrize(
    "setting, said",
    [
        ("time.dt", "must be key=value, such as --set time.dt=0.01"),
        ("=3", "must be key=value"),
        ("time..dt=3", "must be key=value"),
        ("gravity.2=3", "gravity is a list; its items are numbered 0 to 1"),
        ("gravity.-1=3", "gravity is a list; its items are numbered 0 to 1"),
        ("gravity.x=3", "gravity is a list"),
        ("time.dt.x=3", "time.dt is 0.01, not a table"),
    ],
)
def test_a_setting_without_a_place_is_refused(tmp_path, setting, said):
    with pytest.raises(InputError) as caught:
        load_scene(written(tmp_path), [setting])
    assert f"--set {setting}: " in str(caught.value) and said in str(caught.value)


def test_a_resumed_run_may_change_what_its_state_does_not_hang_on(tmp_path):
    path = written(tmp_path)
    scene = load_scene(path, ["time.end=3.0", "output.every=0.1", "checkpoint.keep=1"], only=RESUMABLE)
    assert (scene.time.end, scene.output.every, scene.checkpoint.keep) == (3.0, 0.1, 1)
    scene = load_scene(path, ["time.dt=0.02", "solids.layer.damping.mass=3.0"], only=RESUMABLE)
    assert (scene.time.dt, scene.solids["layer"].damping.mass) == (0.02, 3.0)
    for setting in ("time={}", "outputs.every=1", "solids.layer.young=1", "solids.damping.mass=1", "output={}"):
        with pytest.raises(InputError, match="a run that goes on may change time.end, time.dt, .* petfsi run NEW.toml"):
            load_scene(path, [setting], only=RESUMABLE)


# ---- what the rest reads ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "end, dt, steps", [(2.0, 0.01, 200), (0.3, 0.1, 3), (1.0, 0.3, 4), (0.1, 0.1, 1), (1.0, 1e-6, 10**6), (0.7, 0.1, 7)]
)
def test_steps_reach_the_end_and_round_off_adds_none(end, dt, steps):
    stepping = Stepping(scene_from_dict(layer(f"time.end={end}", f"time.dt={dt}")).time)
    assert stepping.count(0) == steps
    assert stepping.finished(stepping.after(steps, 0.0, dt), dt)
    assert not stepping.finished(stepping.after(steps - 1, 0.0, dt), dt)


@pytest.mark.parametrize("end, dt", [(0.3, 0.1), (0.7, 0.1), (0.9, 0.3), (0.6, 0.2), (1.0, 1 / 3), (1.1, 0.00011)])
def test_times_are_multiples_on_paper_and_the_last_is_the_end(end, dt):
    stepping = Stepping(scene_from_dict(layer(f"time.end={end}", f"time.dt={dt}")).time)
    stepping.length(0.0)
    n = stepping.count(0)
    assert stepping.after(n, 0.0, dt) == end
    assert stepping.after(3, 0.0, dt) == float(f"{3 * dt:.12g}")


@pytest.mark.parametrize(
    "end, dt, last",
    [(1.0, "0.3", [0.3, 0.2, 0.2]), (1.0, "0.4", [0.4, 0.3, 0.3]), (1.5, "1.0", [0.75, 0.75])]
    + [(2.0, "0.1", [0.1, 0.1, 0.1]), (2.0, "0.3*(1 + t)", [0.3, 0.39, 0.507, 0.4015, 0.4015])]
    + [(2.0, "0.9 - 0.1*t", [0.9, 0.55, 0.55])],
)
def test_the_end_is_met_and_the_last_two_steps_share_what_is_left(end, dt, last):
    stepping = Stepping(scene_from_dict(layer(f"time.end={end}", f"time.dt={dt}")).time)
    counted, t, taken = stepping.count(100), 0.0, []
    while not taken or not stepping.finished(t, taken[-1]):
        taken.append(stepping.length(t))
        t = stepping.after(len(taken), t, taken[-1])
    assert t == end
    assert taken[-len(last) :] == pytest.approx(last, rel=1e-9)
    assert counted == len(taken)


def test_a_run_that_is_given_a_later_end_counts_its_steps_from_the_old_one():
    ended = Stepping(scene_from_dict(layer("time.end=1.0", "time.dt=0.3")).time)
    t = 0.0
    for step in range(1, 5):
        t = ended.after(step, t, ended.length(t))
    assert ended.stored == (0.3, 4, 1.0)
    later = Stepping(scene_from_dict(layer("time.end=2.0", "time.dt=0.3")).time)
    later.go_on(4, t, ended.stored)
    assert later.after(5, t, later.length(t)) == 1.3 and later.count(0) == 8


@pytest.mark.parametrize(
    "dt, steps", [("0.1", 20), ("0.1 + 0*t", 20), ("0.1*(1 + (t >= 1 - 1e-9))", 15), ("0.3 + t", 3)]
)
def test_steps_of_any_length_reach_the_end(dt, steps):
    stepping = Stepping(scene_from_dict(layer(f"time.dt={dt}")).time)
    assert stepping.count(100) == steps
    assert stepping.constant == (dt == "0.1")
    assert stepping.constant or stepping.count(steps - 1) is None


def test_a_step_that_shrinks_to_nothing_is_told():
    stepping = Stepping(scene_from_dict(layer("time.dt=0.5 - t/2")).time)
    with pytest.raises(InputError, match=r"time.dt = '0.5 - t/2': is 0 at t = 1; must be greater than 0"):
        stepping.length(1.0)
    with pytest.raises(InputError, match=r"is 5.00155e-14 at t = 1; must be greater than 1e-12 of time.end"):
        stepping.length(1.0 - 1e-13)
    assert stepping.count(1000) is None


@pytest.mark.parametrize("stable, steps", [(np.inf, 1), (3.0, 1), (2.0, 2), (1.0, 3), (0.1, 23), (2.0001 / 0.9, 1)])
def test_steps_of_auto_end_at_the_end(stable, steps):
    """Two seconds; the last two steps share what is left."""
    table = layer('time.dt="auto"', "time.end=2.0", 'time.integrator="symplectic-euler"')
    stepping = Stepping(scene_from_dict(table).time)
    t, n, dt = 0.0, 0, 2.0
    while not stepping.finished(t, dt):
        dt = stepping.length(t, stable)
        assert 0.0 < dt <= 0.9 * stable
        t, n = stepping.after(n + 1, t, dt), n + 1
    assert t == pytest.approx(2.0, rel=1e-14) and n == steps


@pytest.mark.parametrize("stable", [0.0, 1e-20, np.nan])
def test_a_stable_step_that_is_nothing_is_told(stable):
    table = layer('time.dt="auto"', "time.end=2.0", 'time.integrator="symplectic-euler"')
    with pytest.raises(InputError, match=r'time.dt = "auto": the stable step is .* s at t = 0.5; .* 1e-12 of time.end'):
        Stepping(scene_from_dict(table).time).length(0.5, stable)


def test_a_mesh_outside_the_grid_is_refused():
    scene = scene_from_dict(layer())
    check_inside_grid(scene, "solids.bunny.shape", np.array([[0.0, 0.0], [1.0 + 1e-12, 2.0]]))
    with pytest.raises(InputError, match=r'solids.bunny.shape = "y from -0.5 to 0.5 m": y must lie inside'):
        check_inside_grid(scene, "solids.bunny.shape", np.array([[0.5, 0.5], [0.5, -0.5]]))
    # the top is open: a solid may float there, but not lie beyond it
    check_inside_grid(scene, "solids.bunny.shape", np.array([[0.5, 0.5], [0.5, 2.5]]))
    with pytest.raises(InputError, match=r'"y from 2.1 to 2.5 m": y must lie inside'):
        check_inside_grid(scene, "solids.bunny.shape", np.array([[0.5, 2.1], [0.5, 2.5]]))
    dry = without(layer(), "fluid", "obstacles", "probes.gauge")
    check_inside_grid(scene_from_dict(dry), "solids.bunny.shape", np.array([[9.0, 9.0]]))


def test_every_expression_of_a_scene_is_found():
    assert [key for key, _, _ in expressions(scene_from_dict(layer("fluid.initial.velocity=[0, 'x']")))] == [
        "gravity.0",
        "gravity.1",
        "fluid.initial.velocity.0",
        "fluid.initial.velocity.1",
        "fluid.smoke.initial",
        "fluid.sides.right.inflow.speed",
        "solids.layer.initial.velocity.0",
        "solids.layer.initial.velocity.1",
        "solids.layer.supports.0.velocity.x",
    ]


def test_a_scene_cannot_be_changed():
    scene = scene_from_dict(layer())
    with pytest.raises(ValueError, match="frozen"):
        scene.time.dt = 1.0
    assert isinstance(scene, Scene)
