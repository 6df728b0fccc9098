"""Loads on beams: exact deflections and rotations, work, momentum, and followers."""

import numpy as np
import pytest
from mpi4py import MPI
from solid_cases import gathered, step
from step_cases import prepared
from test_beams import CLAMP, beam, field

from petfsi.errors import InputError
from petfsi.fields.solid.elements import State
from petfsi.scene.schema import Scene

#: EI = 1 and EA = 1.3e6 for a length of 1.
SLENDER = {"thickness": 0.003, "start": (0.0, 0.0), "end": (1.0, 0.0)}
YOUNG = 12 / 0.003**3


def cantilever(loads, theory="timoshenko", elements=8, **more):
    return beam(theory, elements, **SLENDER, supports=CLAMP, loads=loads, **more) | {"young": YOUNG}


def forces(solid, d=None, time=0.0):
    """Return the loads' forces on all nodes, in the scene's order, and their tangent's product with d."""
    mesh = solid._mesh
    d = np.zeros((mesh.n_owned, 3)) if d is None else d
    at = State(solid._exchange.with_shared(d), *2 * [np.zeros((len(mesh.points), 3))])
    b = np.zeros((mesh.n_owned, 3))
    solid._loads.assemble(time, at, 0.0, None, b)
    return solid._everywhere(b)


def settle(solid, time=0.0, start=None, tolerance=1e-9):
    """Bring a beam on one rank to rest under its loads by Newton's iteration; return the sizes of its moves."""
    mesh, pattern = solid._mesh, solid._pattern
    d, moves = np.zeros((mesh.n_owned, 3)) if start is None else start, []
    zero = np.zeros_like(d)
    held = np.isin(np.arange(d.size), solid._supports.unknowns)
    for _ in range(80):
        values, b = np.zeros(len(pattern.indices)), np.zeros_like(d)
        solid._elements.assemble(State(d, zero, zero), 0.0, 1.0, pattern, values, b)
        solid._loads.assemble(time, State(d, zero, zero), 1.0, values, b)
        K = np.zeros((d.size, d.size))
        K[np.repeat(np.arange(d.size), np.diff(pattern.indptr)), pattern.indices] = values
        move = np.zeros(d.size)
        move[~held] = np.linalg.solve(K[np.ix_(~held, ~held)], b.ravel()[~held])
        d = d + move.reshape(d.shape)
        moves.append(np.abs(move).max())
        if moves[-1] < tolerance:
            solid.displacement = d
            return moves
    raise AssertionError(f"Newton's iteration does not converge: {moves}")


@pytest.fixture(params=["timoshenko", "euler-bernoulli"])
def theory(request):
    return request.param


# ---- small ones ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "load, tip",
    [
        ({"at": [1.0, 0.0], "force": [0.0, 1e-3]}, (1e-3 / 3, 1e-3 / 2)),
        ({"at": [1.0, 0.0], "moment": 1e-3}, (1e-3 / 2, 1e-3)),
        ({"at": [0.3, 0.0], "force": [0.0, 1e-3]}, (1e-3 * 0.09 * 2.7 / 6, 1e-3 * 0.09 / 2)),
        ({"at": [0.3, 0.0], "moment": 1e-3}, (1e-3 * 0.3 * 0.85, 3e-4)),
        ({"where": "all", "traction": [0.0, 1e-3]}, (1e-3 / 8, 1e-3 / 6)),
        ({"where": "all", "pressure": -1e-3}, (1e-3 / 8, 1e-3 / 6)),
        ({"where": "all", "traction": [0.0, "1e-3*x"]}, (11e-3 / 120, 1e-3 / 8)),
        (
            {"where": {"box": {"origin": [0.5, -1.0], "size": [0.5, 2.0]}}, "traction": [0.0, 1e-3]},
            (41e-3 / 384, 7e-3 / 48),
        ),
    ],
)
def test_a_cantilever_bends_as_in_the_tables(theory, load, tip):
    solid = field(b=cantilever([load], theory))
    settle(solid)
    _, w, angle = gathered_nodes(solid)[-1]
    # a load between the nodes of a shearing beam is shared out, which costs a little
    np.testing.assert_allclose((w, angle), tip, rtol=5e-3 if load.get("at", [1])[0] == 0.3 else 1e-4)


def gathered_nodes(solid):
    return solid._everywhere(solid.displacement)


def test_a_body_force_is_that_of_gravity(theory):
    loaded = field(b=beam(theory, supports=CLAMP, body_force=[0.3 * 1.3, -2.0 * 1.3]))
    heavy = field(gravity=[0.3, -2.0], b=beam(theory, supports=CLAMP))
    for k in range(3):
        step(loaded, 0.1 * k, 0.1)
        step(heavy, 0.1 * k, 0.1)
    np.testing.assert_allclose(loaded.displacement, heavy.displacement, atol=1e-13)


@pytest.mark.parallel([1, 3])
def test_loads_add_up_on_any_number_of_ranks(theory):
    loads = [{"where": "all", "traction": ["2 + t", "x*t"]}, {"at": [0.3, 0.4], "force": [1.0, "y"], "moment": "x*t"}]
    solid = field(MPI.COMM_WORLD, b=beam(theory, loads=loads, body_force=["3*x", 0.0]))
    for time in (0.0, 2.0):
        total = forces(solid, time=time)
        # of x the mean is 0.375; the thickness is 0.1 and the length 1.25
        exact = [1.25 * (2 + time) + 1.0 + 3 * 0.375 * 0.125, 0.375 * 1.25 * time + 0.4]
        np.testing.assert_allclose(total[:, :2].sum(axis=0), exact, rtol=1e-12)
    alone = field(MPI.COMM_SELF, b=beam(theory, loads=loads, body_force=["3*x", 0.0]))
    np.testing.assert_allclose(total, forces(alone, time=2.0), atol=1e-13)


# ---- large ones ---------------------------------------------------------------------------------------------


def test_a_dead_tip_force_gives_the_elastica_and_a_follower_bends_on():
    """Dead: alpha = 5, see test_beam_elements. A follower's root moment is its force times the lever it ends with."""
    dead = field(b=cantilever([{"at": [1.0, 0.0], "force": [0.0, "5*t"]}]))
    settle(dead, 0.4)
    settle(dead, 1.0, dead.displacement)
    np.testing.assert_allclose(gathered_nodes(dead)[-1, :2], (-0.3876283607, 0.7137915236), rtol=1e-3)
    follower = field(b=cantilever([{"at": [1.0, 0.0], "force": [0.0, "5*t"], "follower": True}], elements=16))
    for time in np.linspace(0.1, 1.0, 10):
        settle(follower, time, follower.displacement)
    d = gathered_nodes(follower)
    assert d[-1, 2] > 1.5 * gathered_nodes(dead)[-1, 2]
    x = np.array([1.0, 0.0]) + d[-1, :2]
    force = 5 * np.array([-np.sin(d[-1, 2]), np.cos(d[-1, 2])])
    bent = d[2, 2] - d[0, 2]  # over the first element, so at its middle
    middle = np.array([1 / 32, 0.0]) + d[1, :2]
    lever = x - middle
    assert bent * 16 == pytest.approx(lever[0] * force[1] - lever[1] * force[0], rel=2e-3)


def test_a_follower_pressure_bends_a_beam_into_an_arc_whose_ends_meet_its_resultant():
    """On a chord under even pressure the resultant is that of the chord: p times its length, at a right angle."""
    solid = field(b=cantilever([{"where": "all", "pressure": "-8*t"}]))
    for time in np.linspace(0.1, 1.0, 10):
        settle(solid, time, solid.displacement)
    d = gathered_nodes(solid)
    total = forces(solid, solid.displacement, 1.0)[:, :2].sum(axis=0)
    chord = np.array([1.0, 0.0]) + d[-1, :2]
    assert chord[1] > 0.5
    np.testing.assert_allclose(total, 8 * np.array([-chord[1], chord[0]]), rtol=2e-3, atol=1e-3)


def test_a_followers_tangent_is_the_symmetric_part_of_its_derivative(theory):
    loads = [{"where": "all", "pressure": 3.0}, {"at": [0.3, 0.4], "force": [1.0, -2.0], "follower": True}]
    solid = field(b=beam(theory, 2, loads=loads))
    d = 0.3 * np.random.default_rng(1).standard_normal(solid.displacement.shape)
    values = np.zeros(len(solid._pattern.indices))
    zero = np.zeros_like(d)
    solid._loads.assemble(0.0, State(d, zero, zero), 1.0, values, np.zeros_like(d))
    K = np.zeros((d.size, d.size))
    K[np.repeat(np.arange(d.size), np.diff(solid._pattern.indptr)), solid._pattern.indices] = -values
    numbers = np.argsort(solid._number)
    exact = np.zeros_like(K)
    for j, move in enumerate(1e-6 * np.eye(d.size).reshape(-1, *d.shape)):
        exact[:, j] = (forces(solid, d + move)[numbers] - forces(solid, d - move)[numbers]).ravel() / 2e-6
    np.testing.assert_allclose(K, (exact + exact.T) / 2, atol=1e-8)


# ---- by the program -----------------------------------------------------------------------------------------


def static(load, steps, elements):
    """Return the tip's place and angle at the end, and the iterations of each step of load."""
    scene = {
        "dim": 2,
        "time": {"end": 1.0, "dt": 1 / steps, "integrator": "static", "retries": 0},
        "solids": {"b": cantilever([load], elements=elements)},
        "probes": {q: {"of": "b", "at": [1.0, 0.0], "quantity": q} for q in ("displacement", "angle")},
    }
    with prepared(Scene.model_validate(scene)) as sim:
        counts = []
        for _ in range(steps):
            sim.advance()
            counts.append(sim.outcome.newton)
        return sim.probe(), counts


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize(
    "alpha, exact",
    [(1, (0.0564332363, 0.3017207738)), (2, (0.1606417208, 0.4934574804)), (5, (0.3876283607, 0.7137915236)),
     (10, (0.5549955978, 0.8106090249))],
)  # fmt: skip
def test_statics_find_the_elastica(alpha, exact):
    (u, w, _), counts = static({"at": [1.0, 0.0], "force": [0.0, f"{alpha}*t"]}, 10, 8)
    np.testing.assert_allclose((-u, w), exact, rtol=1e-3)
    assert max(counts) < 20


def test_statics_roll_a_beam_up_into_a_circle():
    (u, w, angle), counts = static({"at": [1.0, 0.0], "moment": "2*pi*t"}, 10, 10)
    assert np.hypot(1 + u, w) < 1e-3
    assert angle == pytest.approx(2 * np.pi, rel=1e-8)
    assert max(counts) < 20


@pytest.mark.parametrize("force", [1e-6, 1.0, 100.0])
@pytest.mark.parametrize("angle", [0.0, 0.3, 0.93, 2.0, 4.4])
@pytest.mark.parametrize("part", [0.5, 0.55, 1.0])
def test_a_load_that_stays_leaves_an_equilibrium_as_it_is(part, angle, force):
    """Axial strains of 1e-10 beside an axis of length 1 are found; where they drowned, Newton had no end at rest."""
    along = np.array([np.cos(angle), np.sin(angle)])
    across, start = np.array([-along[1], along[0]]), np.array([0.1, 0.2])
    load = {"at": list(start + part * along), "force": list(force * across)}
    shape = {"thickness": 0.01, "start": tuple(start), "end": tuple(start + along)}
    solid = beam("timoshenko", 10, **shape, supports=CLAMP, loads=[load]) | {"young": 1e9, "poisson": 0.3}
    scene = {
        "dim": 2,
        "time": {"end": 1.0, "dt": 0.25, "integrator": "static", "retries": 0},
        "solids": {"b": solid},
        "probes": {"tip": {"of": "b", "at": list(start + along), "quantity": "displacement"}},
    }
    with prepared(Scene.model_validate(scene)) as sim:
        counts = []
        for _ in range(4):
            sim.advance()
            counts.append(sim.outcome.newton)
        tip = sim.probe() @ across
    assert max(counts[1:]) <= 1
    EI = 1e9 * 0.01**3 / 12
    exact = force * part**2 * (3 - part) / (6 * EI)
    assert tip == pytest.approx(exact, rel=1e-3 + exact**2)  # shear, and what of the elastica is beyond the tables


def test_a_beam_that_turns_too_far_for_its_theory_is_told_of_once():
    """At P l^2/EI = 0.6 the tip of Euler-Bernoulli's moves by .2, the elastica's by .1924."""
    scene = {
        "dim": 2,
        "time": {"end": 1.0, "dt": 0.25, "integrator": "static"},
        "solids": {"b": cantilever([{"at": [1.0, 0.0], "force": [0.0, "0.7*t"]}], "euler-bernoulli")},
    }
    told = []
    for theory in ("euler-bernoulli", "timoshenko"):
        scene["solids"]["b"]["shape"]["beam"]["theory"] = theory
        with prepared(Scene.model_validate(scene)) as sim:
            sim.report = told.append
            for _ in range(4):
                sim.advance()
    assert len(told) == 1 and "t = 1 s: solids.b has turned by 0.35 rad" in told[0]


# ---- in motion ----------------------------------------------------------------------------------------------


def angular_momentum(solid):
    x = solid.reference + solid.displacement[:, :2]
    u = solid.velocity
    turn = np.column_stack((-x[:, 1], x[:, 0], np.ones(len(x))))
    M = solid._elements.mass
    each = solid._elements._of_elements
    return float(np.einsum("ei,eij,ej->", each(turn), M, each(u)))


def test_flying_spaghetti_keeps_its_momentum_and_its_energy():
    """A free rod, EA = GA = 10^4, EI = 500, rho A = 1 over a length of 10, pushed and turned for 2.5 s.

    J. C. Simo, L. Vu-Quoc, On the dynamics of flexible beams under large overall motions, J. Appl. Mech. 53 (1986), but
    with the rotary inertia of the section.
    """
    thickness = np.sqrt(12 * 0.05)
    shear = 5 / 6 / 2 - 1  # what makes GA = EA
    loads = [{"at": [6.0, 0.0], "force": ["8*heaviside(2.5 - t)", 0.0], "moment": "-80*heaviside(2.5 - t)"}]
    rod = beam(elements=5, start=(6.0, 0.0), end=(0.0, 8.0), thickness=thickness, loads=loads)
    rod |= {"young": 1e4 / thickness, "poisson": shear, "density": 1 / thickness}
    time = {"end": 5.0, "dt": 0.0125, "integrator": "midpoint"}
    scene = Scene.model_validate({"dim": 2, "time": time, "solids": {"b": rod}})
    with prepared(scene, "-fsi_snes_type", "newtonls", comm=MPI.COMM_SELF) as sim:
        solid, kept, bent = sim.solid, [], 0.0
        np.testing.assert_allclose(solid._elements.sections.stiffness, [[1e4, 1e4, 500]], rtol=1e-12)
        for k in range(400):
            sim.advance()
            bent = max(bent, np.ptp(gathered_nodes(solid)[:, 2]))
            if k >= 200:
                kept.append([angular_momentum(solid), sum(solid.energies().values())])
            if k in (199, 399):
                np.testing.assert_allclose(solid.stock().momentum, [20.0, 0.0], atol=1e-8)
    spin, energy = np.array(kept).T
    assert abs(spin[0]) > 100
    np.testing.assert_allclose(spin, spin[0], rtol=1e-9)
    assert np.ptp(energy) < 0.005 * energy.mean()
    assert np.abs(solid.displacement[:, 2]).max() > np.pi
    assert bent > 1.0


def test_loads_work_on_the_way_of_their_points(theory):
    loads = [{"at": [0.3, 0.4], "force": [2.0, -1.0], "moment": 0.5}]
    solid = field(integrator="midpoint", b=beam(theory, supports=CLAMP, loads=loads))
    place = [0.3, 0.4]
    for k in range(4):
        before = [*solid.probe("b", place, "displacement"), *solid.probe("b", place, "angle")]
        step(solid, 0.02 * k, 0.02)
        after = [*solid.probe("b", place, "displacement"), *solid.probe("b", place, "angle")]
        assert solid.forces()["loads"] @ solid.moved == pytest.approx(
            np.subtract(after, before) @ [2.0, -1.0, 0.5], rel=1e-10
        )


@pytest.mark.parametrize(
    "load, said",
    [
        (
            {"where": "end", "traction": [1.0, 0.0]},
            r"loads.0.where: none of the 6 boundary facets .of a beam: elements. lies",
        ),
        ({"at": [5.0, 0.0], "force": [1.0, 0.0]}, r"solids.b.loads.0.at = \[5.0, 0.0\]: lies .* m away from the solid"),
    ],
)
def test_a_load_beside_the_beam_is_refused(load, said):
    with pytest.raises(InputError, match=said):
        field(b=beam(loads=[load]))


@pytest.mark.parallel([2, 3])
def test_ranks_agree_on_followers():
    loads = [{"where": "all", "pressure": "2*t"}, {"at": [0.75, 1.0], "force": [0.3, 0.0], "follower": True}]
    ends = []
    for comm in (MPI.COMM_SELF, MPI.COMM_WORLD):
        solid = field(comm, integrator="bdf2", b=beam(supports=CLAMP, loads=loads))
        for k in range(4):
            step(solid, 0.1 * k, 0.1)
        ends.append(gathered(solid, "displacement"))
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-10)


@pytest.mark.parallel([1, 3])
def test_an_explicit_beam_swings_below_its_limit_and_is_refused_above(theory):
    shape = {"thickness": 0.1, "start": (0.0, 0.0), "end": (1.0, 0.0)}
    bar = beam(theory, 4, **shape, supports=CLAMP, initial={"velocity": [0.0, "0.2*x*x", "0.4*x"]})

    def scene(dt):
        time = {"end": 50.0, "dt": dt, "integrator": "symplectic-euler"}
        return Scene.model_validate({"dim": 2, "time": time, "solids": {"b": bar}})

    with prepared(scene(1e-3)) as sim:
        limit = sim.solid.stable_step()
        solid = field(b=bar | {"mass": "lumped"})
        zero = np.zeros_like(solid.displacement)
        mass = solid._elements.lumped_mass(len(zero)).ravel()
        free = np.setdiff1d(np.arange(zero.size), solid._supports.unknowns)
        values = np.zeros(len(solid._pattern.indices))
        solid._elements.assemble(State(zero, zero, zero), 0.0, 1.0, solid._pattern, values, zero.copy())
        K = np.zeros((zero.size, zero.size))
        K[np.repeat(np.arange(zero.size), np.diff(solid._pattern.indptr)), solid._pattern.indices] = values
        pencil = (K / np.sqrt(np.outer(mass, mass)))[np.ix_(free, free)]
        assert limit == pytest.approx(2 / np.sqrt(np.linalg.eigvalsh(pencil)[-1]), rel=0.02)
    with prepared(scene(0.9 * limit)) as sim:
        energy = []
        for _ in range(1000):
            sim.advance()
            energy.append(sum(sim.solid.energies().values()))
        assert np.ptp(energy) < 0.05 * np.mean(energy)
    with pytest.raises(InputError, match="the stable step of symplectic-euler is"), prepared(scene(1.1 * limit)):
        pass
