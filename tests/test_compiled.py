"""Functions compiled for several things must not be taken for each other."""

import re
from pathlib import Path

import numpy as np

import petfsi
from petfsi.compiled import compiled_for
from petfsi.fields.solid.kernels import kernels
from petfsi.fields.sph.loops import density_loop

SOURCES = sorted(Path(petfsi.__file__).parent.rglob("*.py"))


def make(scale):
    @compiled_for(scale)
    def times(x):
        return scale * x

    return times


def test_what_a_function_is_for_is_in_its_name():
    twice, thrice = make(2), make(3)
    assert (twice(1.5), thrice(1.5)) == (3.0, 4.5)
    names = [one.overloads[one.signatures[0]].fndesc.llvm_func_name for one in (twice, thrice)]
    assert "times_2" in names[0] and "times_3" in names[1]
    made = [kernels(dim, nodes, plain).tangent for dim, nodes, plain in ((2, 3, True), (2, 6, False), (3, 4, True))]
    made += [density_loop(dim, kernel, True) for dim in (2, 3) for kernel in (0, 1)]
    assert len({one.py_func.__qualname__ for one in made}) == len(made)


def test_no_closure_is_compiled_without_it():
    assert len(SOURCES) > 250
    plain = [path.name for path in SOURCES if re.search(r"^ +@(numba\.)?njit", path.read_text(), re.MULTILINE)]
    assert plain == []


def test_dimensions_do_not_mix():
    for dim in (3, 2, 3):
        d = np.arange(dim * (dim + 1), dtype=float).reshape(-1, dim)
        H = np.empty((1, dim, dim))
        basis = np.vstack((-np.ones(dim), np.eye(dim)))[None]
        kernels(dim, dim + 1, True).gradient(np.arange(dim + 1)[None], basis, np.ones((1, dim + 1, 1)), d, H)
        np.testing.assert_allclose(H[0], np.einsum("ai,aj->ij", d, basis[0]))
