"""Functions that are compiled once for each of several things: dimensions, kernels, kinds of walls."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit


def compiled_for(*what: object, **options: Any) -> Callable[[Callable], Callable]:
    """Return a decorator that compiles a function made for something, and keeps what it compiles in Numba's cache.

    Numba calls what it makes by the function's name, its signature and a number that counts from 1 in every process.
    A process that takes functions for 2D and 3D from the cache, made by two others, may have two of one name: then it
    runs one with the constants of the other, or with none (a SystemError). So what a function is for is in its name.

    Parameters
    ----------
    *what : object
        All constants of the function's closure that its instances differ by.
    **options
        Of ``numba.njit``.
    """

    def compile_it(function: Callable) -> Callable:
        mark = "_".join(map(str, what))
        function.__name__ = f"{function.__name__}_{mark}"
        function.__qualname__ = f"{function.__qualname__}_{mark}"
        kernel: Callable = njit(cache=True, **options)(function)
        return kernel

    return compile_it
