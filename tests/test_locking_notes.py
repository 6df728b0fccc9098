"""Linear elements that bend too stiffly: as much as `check` says, and wherever they do."""

import pytest
from step_cases import prepared
from test_notes import ALL, CLAMP, ROLLER, WARNED, X, bar, scene, warned

from petfsi.notes.bending import excess
from petfsi.notes.forms import form_of


@pytest.mark.parametrize("supports", [CLAMP, [X, ROLLER]], ids=["clamped", "a plane of symmetry"])
@pytest.mark.parametrize("integrator", ["bdf2", "static"])
def test_what_locks_is_warned_of_however_it_is_held(supports, integrator):
    made = scene(bar((20, 1), supports=supports), time={"integrator": integrator}, dt=0.01)
    assert "1 across it, poisson = 0.3: it bends about 2.9 times too stiffly" in warned(made)[0]


ONE_ALONG = {
    "a bar": (scene(bar(cells=(1, 1))), "1.9 s"),
    "two across": (scene(bar(cells=(1, 2))), "1.9 s"),
    "a plate": (
        scene(bar((1, 1, 1), (0.05, 1.0, 0.4), [{"where": "bottom", "fix": ALL}]), dim=3, dt=0.2), "3.9 s"),
    "a plane of symmetry": (scene(bar(cells=(1, 1), supports=[X, ROLLER])), "2.7 s"),
}  # fmt: skip


@pytest.mark.parametrize(("made", "period"), ONE_ALONG.values(), ids=ONE_ALONG)
def test_what_is_one_element_long_locks_most(made, period):
    said = warned(made)
    assert "it bends more than 30 times too stiffly (locking)" in said[0]
    assert f"its slowest bending takes about {period}" in said[1]


STIFF = [
    (2, 1, 20, {}), (2, 2, 40, {"poisson": 0.45}), (2, 2, 10, {}), (2, 1, 10, {"volumetric": "reduced"}),
    (3, 1, 10, {"poisson": 0.49}), (3, 2, 20, {"poisson": 0.495}),
    (3, 2, 20, {"volumetric": "reduced", "poisson": 0.49}),
]  # fmt: skip


@pytest.mark.parametrize(("dim", "n", "along", "more"), STIFF)
def test_linear_elements_lock_as_much_as_is_said_to_a_factor_of_two(dim, n, along, more):
    length = 10.0
    supports = [{"where": "left", "fix": ["x", "y", "z"][:dim]}]
    loads = [{"where": "right", "traction": [0.0, 1e-3, 0.0][:dim], "follower": False}]
    size, cells = (length, 1.0, 1.0)[:dim], (along, n, n)[:dim]
    solid = bar(cells, size, supports, loads=loads, material="linear") | more
    probe = {"of": "b", "at": [length, 0.5, 0.5][:dim], "quantity": "displacement"}
    made = scene(solid, dim=dim, dt=1.0, time={"integrator": "static"}, probes={"tip": probe})
    with prepared(made) as sim:
        sim.advance()
        tip = sim.probe()[1]
    body = made.solids["b"]
    young = 1e6 / (1 - body.poisson**2 if dim == 2 else 1)
    exact = 1e-3 * (length**3 / (3 * young / 12) + length / (5 / 6 * 1e6 / (2 * (1 + body.poisson))))
    assert 0.5 < excess(body, form_of(body, dim, None).bend(-1), dim, body.volumetric) / (exact / tip - 1) < 2.0


#: Boxes of which a cavity leaves walls that are short, or thicker than its own box says; too stiff by less than half.
HOLLOW = {
    "a notch": ((9, 9), (1.0, 1.0), [0.7, 0.3], [0.25, 0.25]),
    "a short wall": ((9, 9), (1.0, 1.0), [0.6, 0.3], [0.25, 0.25]),
    "a thick wall": ((9, 9), (1.0, 1.0), [0.3, 0.3], [0.4, 0.4]),
    "a thick tube": ((6, 24, 6), (1.0, 6.0, 1.0), [1 / 3, -1.0, 1 / 3], [1 / 3, 8.0, 1 / 3]),
}


def hollow(cells, size, low, wide):
    """Return a hollow box, what is warned of with linear and quadratic elements, and how much stiffer the first are."""
    dim = len(size)
    supports = [{"where": "bottom", "fix": ["x", "y", "z"][:dim]}]
    loads = [{"where": "top", "traction": [1.0, 0.0, 0.0][:dim], "follower": False}]
    body = bar(cells, size, supports, loads=loads, material="linear")
    body["shape"] = body["shape"] | {"cavity": {"origin": low, "size": wide}}
    probe = {"of": "b", "at": [0.0, size[1], 0.0][:dim], "quantity": "displacement"}
    tips, said = [], []
    for elements in ("linear", "quadratic"):
        made = scene(
            body | {"elements": elements}, dim=dim, dt=1.0, time={"integrator": "static"}, probes={"tip": probe}
        )
        said.append(warned(made)[0])
        with prepared(made) as sim:
            sim.advance()
            tips.append(sim.probe()[0])
    return made.solids["b"], said, tips[1] / tips[0]


@pytest.mark.parametrize(("cells", "size", "low", "wide"), HOLLOW.values(), ids=HOLLOW)
def test_walls_are_those_that_the_mesh_has(cells, size, low, wide):
    _, said, times = hollow(cells, size, low, wide)
    assert said == ["", ""] and times < 1.5


def test_walls_of_a_tube_bend_round_it():
    """Its elements are five times as long as thick along it, which says nothing of how its walls sway."""
    solid, said, times = hollow((10, 10, 4), (1.0, 1.0, 2.0), [0.1, 0.1, -1.0], [0.8, 0.8, 4.0])
    wall = form_of(solid, 3, None).wall
    assert wall == (1.0, pytest.approx(1.0)) and "1 across its wall" in said[0] and not said[1]
    assert 0.5 < excess(solid, wall, 3, solid.volumetric) / (times - 1) < 2.0


def test_what_is_advised_against_locking_helps():
    """Of the case that is warned of most: 18 times too stiff."""
    said = warned(WARNED["few across 3D"][0])[0]
    assert 'elements = "quadratic"' in said and 'volumetric = "reduced" and 4 across' in said
    clamp = [{"where": "left", "fix": ["x", "y", "z"]}]
    helped = [
        bar((20, 2, 2), (1.0, 0.1, 0.1), clamp, poisson=0.495, elements="quadratic"),
        bar((40, 4, 4), (1.0, 0.1, 0.1), clamp, poisson=0.495, volumetric="reduced"),
    ]
    assert [warned(scene(solid, dim=3))[0] for solid in helped] == ["", ""]
