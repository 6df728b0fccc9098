"""What the picture of a history shows: panels, units, names. About 5 s."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from picture_cases import block, fluid, particles

from petfsi.output.history_figure import history_figure, history_panels
from petfsi.scene.load import scene_from_dict

ROWS = 4


def table(*names, **values):
    """Return a history in which all of these columns vary, but for those given."""
    columns = ["step", "time", "dt", *names]
    rising = {name: np.arange(1.0, ROWS + 1) * (n + 1) for n, name in enumerate(columns)}
    return rising | {name: np.full(ROWS, value) for name, value in values.items()}


def scene(dim, probes, **tables):
    tables = tables or {"fluid": fluid(dim, smoke={}), "solids": {"body": block(dim)}}
    return scene_from_dict({"dim": dim, "time": {"end": 1.0, "dt": 0.1}, "probes": probes, **tables})


def probe(quantity, of="body"):
    where = {} if quantity in ("front", "force") else {"at": [0.6, 0.4]}
    return {"of": of, "quantity": quantity, **where}


def shown(panels):
    return {f"{panel.title}, {panel.unit}": panel.columns for panel in panels}


def test_probes_of_a_quantity_share_a_panel_with_its_unit():
    of_solid = {"tip": probe("displacement"), "mid": probe("displacement"), "fast": probe("velocity")}
    of_fluid = {name: probe(name, "fluid") for name in ("pressure", "smoke")} | {"wake": probe("velocity", "fluid")}
    columns = ["tip.x", "tip.y", "mid.x", "mid.y", "fast.x", "fast.y", "pressure", "smoke", "wake.x", "wake.y"]
    assert shown(history_panels(table(*columns), scene(2, of_solid | of_fluid))) == {
        "displacement, m": ("tip.x", "tip.y", "mid.x", "mid.y"),
        "velocity, m/s": ("fast.x", "fast.y", "wake.x", "wake.y"),
        "pressure, Pa": ("pressure",),
        "smoke, 1": ("smoke",),
    }


def test_what_probes_of_beams_and_particles_say_has_units():
    beam = {"shape": {"beam": {"start": [0.6, 0.4], "end": [0.6, 0.8], "thickness": 0.02, "elements": 4}}}
    body = {"density": 1.0, "young": 1e3, "poisson": 0.3, **beam}
    probes = {"turn": probe("angle"), "front": probe("front", "fluid"), "level": probe("level", "fluid")}
    probes["push"] = probe("force", "right")
    found = history_panels(
        table("turn", "front", "level", "push.x", "push.y"),
        scene(2, probes, fluid=particles(2), solids={"body": body}),
    )
    assert list(shown(found)) == ["angle, rad", "front, m", "level, m", "force, N/m"]


ACCOUNTS = """iterations residual newton substeps volume_error divergence region_volume.1 region_volume.2 momentum.x
momentum.y kinetic elastic potential dissipated load_work boundary_work energy_residual mass mass_in mass_out
particles put_back""".split()


@pytest.mark.parametrize("known", [True, False], ids=["with its scene", "without"])
@pytest.mark.parametrize("dim, per", [(2, "/m"), (3, "")])
def test_accounts_have_panels_with_units(dim, per, known):
    columns = [*ACCOUNTS, "momentum.z"] if dim == 3 else ACCOUNTS
    found = shown(history_panels(table(*columns), scene(dim, {}) if known else None))
    volume = "m$^3$" if dim == 3 else "m$^2$"
    assert list(found) == [
        "volume error, 1", "divergence, m/s", f"region volume, {volume}", f"momentum, N s{per}", f"energy, J{per}",
        f"energy residual, J{per}", f"mass, kg{per}", "particles, 1", "put back, 1",
        "iterations, 1", "residual, 1", "newton, 1", "substeps, 1",
    ]  # fmt: skip
    assert found[f"energy, J{per}"][-2:] == ("load_work", "boundary_work")
    assert sorted(name for columns in found.values() for name in columns) == sorted(columns)


def test_panels_of_zeros_are_left_out_and_components_that_are_zero_are_not():
    probes = {"tip": probe("displacement"), "calm": probe("velocity")}
    zeros = dict.fromkeys(("tip.y", "calm.x", "calm.y", "kinetic"), 0.0) | {"divergence": 0.0, "dissipated": -0.0}
    found = shown(history_panels(table("tip.x", "residual", **zeros), scene(2, probes)))
    assert found == {"displacement, m": ("tip.x", "tip.y"), "residual, 1": ("residual",)}
    nothing = table(**zeros)
    assert history_panels(nothing, None) == []
    (text,) = history_figure(nothing).texts
    assert text.get_text() == f"all columns of history.csv are zero in all of {ROWS} rows"


def test_probes_that_no_scene_names_have_panels_of_their_own():
    assert shown(history_panels(table("tip.x", "tip.y", "core"), None)) == {
        "tip, ": ("tip.x", "tip.y"),
        "core, ": ("core",),
    }


def test_round_off_is_no_story():
    values = table("region_volume.1")
    values["region_volume.1"] = 0.09 * (1.0 + 1e-13 * np.arange(ROWS))
    low, high = history_figure(values).axes[0].get_ylim()
    assert low < 0.089 and high > 0.091
    values["region_volume.1"][-1] = np.nan
    assert history_figure(values).axes[0].get_ylim()[0] < 0.089


LONG = "the_{}th_of_the_places_at_which_somebody_in_{}_has_looked_at_the_sinking_block_again"


@pytest.mark.parametrize(
    "names",
    [
        [LONG.format(n, n) for n in range(30)],
        ["a" * 90 + str(n) + "b" * 90 for n in range(8)],
        [f"p{n}" for n in range(3)],
    ],
    ids=["long", "endless", "short"],
)
@pytest.mark.parametrize("quantity, axes", [("displacement", ".x .y"), ("pressure", "")])
def test_no_name_is_cut_or_over_another(names, quantity, axes):
    of = "body" if quantity == "displacement" else "fluid"
    columns = [name + axis for name in names for axis in axes.split() or [""]]
    about = scene(2, {name: probe(quantity, of) for name in names})
    figure = history_figure(table(*columns, "iterations"), about)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    box = figure.get_tightbbox(renderer)
    assert min(box.x0, box.y0, *(figure.get_size_inches() - (box.x1, box.y1))) > -0.01
    legends = [ax.get_legend() for ax in figure.axes if ax.get_legend()]
    labels = [text.get_text() for legend in legends for text in legend.get_texts()]
    assert len(set(labels)) == len(columns) == len(labels)
    drawn = [ax.get_window_extent() for ax in figure.axes] + [legend.get_window_extent(renderer) for legend in legends]
    for n, one in enumerate(drawn):
        for other in drawn[:n]:
            width, height = np.minimum(one.max, other.max) - np.maximum(one.min, other.min)
            assert width < 1.0 or height < 1.0, "they overlap"
