"""Expressions of a scene: arithmetic on x, y, z and t that can reach nothing else.

The text is parsed by Python's own parser, every node of the tree is looked up in a list of what is allowed, and the
tree is turned into NumPy calls. Nothing is ever handed to ``eval``.
"""

from __future__ import annotations

import ast
import difflib
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import reduce

import numpy as np

from petfsi.errors import InputError

MAX_LENGTH = 1000
MAX_DEPTH = 50
MAX_EXPONENT = 100
ALLOWED = "numbers, + - * / **, comparisons and function calls"

CONSTANTS = {"pi": math.pi, "e": math.e}

Values = Mapping[str, np.ndarray]
Term = Callable[[Values], np.ndarray]


@dataclass(frozen=True)
class _Function:
    """A NumPy function and how many arguments it takes; ``None`` is any number from ``least`` on."""

    call: Callable[..., np.ndarray]
    least: int = 1
    most: int | None = 1


def _where(condition: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.where(condition != 0, a, b)


def _heaviside(x: np.ndarray) -> np.ndarray:
    return np.heaviside(x, 1.0)


FUNCTIONS = {
    "where": _Function(_where, 3, 3),
    "min": _Function(lambda *a: reduce(np.minimum, a), 2, None),
    "max": _Function(lambda *a: reduce(np.maximum, a), 2, None),
    "atan2": _Function(np.arctan2, 2, 2),
    "heaviside": _Function(_heaviside),
    "abs": _Function(np.abs),
    "sqrt": _Function(np.sqrt),
    "exp": _Function(np.exp),
    "log": _Function(np.log),
    "sin": _Function(np.sin),
    "cos": _Function(np.cos),
    "tan": _Function(np.tan),
    "asin": _Function(np.arcsin),
    "acos": _Function(np.arccos),
    "atan": _Function(np.arctan),
    "sinh": _Function(np.sinh),
    "cosh": _Function(np.cosh),
    "tanh": _Function(np.tanh),
    "floor": _Function(np.floor),
}

_BINARY: dict[type[ast.operator], Callable[..., np.ndarray]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.Pow: np.power,
}
_COMPARE: dict[type[ast.cmpop], Callable[..., np.ndarray]] = {
    ast.Lt: np.less,
    ast.LtE: np.less_equal,
    ast.Gt: np.greater,
    ast.GtE: np.greater_equal,
    ast.Eq: np.equal,
    ast.NotEq: np.not_equal,
}


class ExpressionError(InputError):
    """An expression that is not allowed, or whose value is not finite; ``reason`` is the text without the key."""

    def __init__(self, label: str, reason: str) -> None:
        super().__init__(f"{label}: {reason}")
        self.label, self.reason = label, reason

    def __reduce__(self) -> tuple:
        return type(self), (self.label, self.reason)  # for the other ranks


class _Refused(Exception):
    """Why an expression is not taken."""


class Expression:
    """A number or a text, parsed once and then evaluated on arrays.

    Allowed are numbers, + - * / **, comparisons (1 where true, else 0) joined by and, or, not, the functions of
    ``FUNCTIONS``, the constants pi and e, and the variables. Not collective.

    Parameters
    ----------
    source : float or str
        What the scene says.
    variables : tuple of str
        The names it may use.
    key : str
        Where it stands in the scene, for messages.

    Attributes
    ----------
    names : frozenset of str
        The variables it uses.
    """

    def __init__(self, source: float | str, variables: tuple[str, ...] = ("x", "y", "z", "t"), key: str = "") -> None:
        self.source = source
        self.key = key
        used: set[str] = set()
        try:
            self._term = _parse(source, variables, used)
        except _Refused as refusal:
            raise ExpressionError(self._label(), str(refusal)) from None
        self.names = frozenset(used)
        if self.is_constant:
            self()

    @property
    def is_constant(self) -> bool:
        """Whether it is the same everywhere and always."""
        return not self.names

    @property
    def depends_on_time(self) -> bool:
        """Whether it changes with t."""
        return "t" in self.names

    def __call__(self, **values: np.ndarray | float) -> np.ndarray:
        """Return the values at the given coordinates and times, broadcast against each other.

        Raises
        ------
        ExpressionError
            Where a value is not finite; on this rank alone, if the others' values are.
        """
        missing = self.names - values.keys()
        if missing:
            raise ValueError(f"{self._label()} needs {', '.join(sorted(missing))}")
        arrays = {name: np.asarray(value, dtype=float) for name, value in values.items()}
        shape = np.broadcast_shapes(*(a.shape for a in arrays.values()))
        with np.errstate(all="ignore"):
            result = np.array(np.broadcast_to(self._term(arrays), shape), dtype=float)
        finite = np.isfinite(result)
        if not finite.all():
            raise ExpressionError(self._label(), f"{self._fault(result, finite, arrays)}; it must be finite")
        return result

    def _fault(self, result: np.ndarray, finite: np.ndarray, arrays: Values) -> str:
        first = np.unravel_index(np.argmin(finite), result.shape)
        used = sorted(self.names)
        place = ", ".join(f"{name} = {np.broadcast_to(arrays[name], result.shape)[first]:g}" for name in used)
        return f"is {result[first]}" + (f" at {place}" if place else "")

    def _label(self) -> str:
        text = self.source if len(str(self.source)) <= 80 else str(self.source)[:77] + "..."
        return f"{self.key or 'expression'} = {text!r}"


def evaluate_at(expression: Expression, points: np.ndarray, time: float) -> np.ndarray:
    """Return an expression's values at points (n, dim); z = 0 in 2D."""
    columns = dict(zip("xyz", points.T, strict=False))
    return expression(t=time, **{name: columns.get(name, np.zeros(len(points))) for name in "xyz"})


def ramp(time: float, duration: float) -> float:
    """Return how far a jet has opened: 0 at time zero, 1 from ``duration`` on, smooth between."""
    if time >= duration:
        return 1.0
    return float(np.sin(0.5 * np.pi * max(time, 0.0) / duration) ** 2)


def _parse(source: float | str, variables: tuple[str, ...], used: set[str]) -> Term:
    """Return the expression as a function of arrays, and note the variables that it uses."""
    if isinstance(source, bool) or not isinstance(source, int | float | str):
        raise _Refused("must be a number or an expression in quotes")
    if not isinstance(source, str):
        return _constant(source)
    if len(source) > MAX_LENGTH:
        raise _Refused(f"has {len(source)} characters; an expression may have {MAX_LENGTH}")
    source = source.strip()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Python's remarks on style, which would reach the user without a key
            tree = ast.parse(source, mode="eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise _Refused(f"is not an expression; allowed are {ALLOWED}") from None
    return _Compiler(source, variables, used).term(tree.body, 0)


def _constant(value: float) -> Term:
    try:
        number = np.asarray(float(value))
    except OverflowError:
        raise _Refused("holds a number beyond 1e308") from None
    return lambda _values: number


class _Compiler:
    """Turns allowed nodes into terms and refuses all others."""

    def __init__(self, source: str, variables: tuple[str, ...], used: set[str]) -> None:
        self.variables = variables
        self.used = used
        self.source = source

    def term(self, node: ast.expr, depth: int) -> Term:
        """Return a node as a function of arrays."""
        if depth > MAX_DEPTH:
            raise _Refused(f"is nested deeper than {MAX_DEPTH} levels")
        match node:
            case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
                return _constant(value)
            case ast.Name(id=name):
                return self._name(name)
            case ast.UnaryOp(op=operator, operand=operand):
                return self._unary(operator, self.term(operand, depth + 1))
            case ast.BinOp(left=left, op=operator, right=right):
                return self._binary(operator, self.term(left, depth + 1), self.term(right, depth + 1), right)
            case ast.Compare(left=left, ops=operators, comparators=rights):
                terms = [self.term(side, depth + 1) for side in (left, *rights)]
                return self._compare(operators, terms)
            case ast.BoolOp(op=operator, values=sides):
                call = np.logical_and if isinstance(operator, ast.And) else np.logical_or
                return _chain(call, [self.term(side, depth + 1) for side in sides])
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=[]):
                return self._call(name, [self.term(argument, depth + 1) for argument in arguments])
        text = ast.get_source_segment(self.source, node) or type(node).__name__
        raise _Refused(f"{text[:40]!r} is not allowed; only {ALLOWED} are")

    def _name(self, name: str) -> Term:
        if name in self.variables:
            self.used.add(name)
            return lambda values: values[name]
        if name in CONSTANTS:
            return _constant(CONSTANTS[name])
        if name in FUNCTIONS:
            raise _Refused(f"the function '{name}' needs its arguments in brackets")
        raise _Refused(_unknown("name", name, [*self.variables, *CONSTANTS]))

    def _unary(self, operator: ast.unaryop, operand: Term) -> Term:
        match operator:
            case ast.USub():
                return lambda values: -operand(values)
            case ast.UAdd():
                return operand
            case ast.Not():
                return lambda values: np.equal(operand(values), 0).astype(float)
        raise _Refused("'~' is not allowed; use not")

    def _binary(self, operator: ast.operator, left: Term, right: Term, right_node: ast.expr) -> Term:
        call = _BINARY.get(type(operator))
        if call is None:
            hint = "; powers are written **" if isinstance(operator, ast.BitXor) else ""
            raise _Refused(f"only the operators + - * / ** are allowed{hint}")
        if call is np.power:
            _check_exponent(right_node)
        return lambda values: call(left(values), right(values))

    def _compare(self, operators: list[ast.cmpop], terms: list[Term]) -> Term:
        calls = [_COMPARE.get(type(operator)) for operator in operators]
        if None in calls:
            raise _Refused("only the comparisons < <= > >= == != are allowed")
        links = [_link(call, a, b) for call, a, b in zip(calls, terms[:-1], terms[1:], strict=True) if call]
        return _chain(np.logical_and, links)

    def _call(self, name: str, arguments: list[Term]) -> Term:
        function = FUNCTIONS.get(name)
        if function is None:
            raise _Refused(_unknown("function", name, list(FUNCTIONS)))
        if len(arguments) < function.least or (function.most is not None and len(arguments) > function.most):
            wanted = f"{function.least}" if function.most is not None else f"{function.least} or more"
            raise _Refused(f"'{name}' takes {wanted} argument(s), not {len(arguments)}")
        return lambda values: function.call(*(argument(values) for argument in arguments))


def _link(call: Callable[..., np.ndarray], left: Term, right: Term) -> Term:
    return lambda values: call(left(values), right(values)).astype(float)


def _chain(call: Callable[..., np.ndarray], terms: list[Term]) -> Term:
    """Join truth values; numbers count as true where they are not 0."""
    if len(terms) == 1:
        return terms[0]
    return lambda values: reduce(call, [np.not_equal(term(values), 0) for term in terms]).astype(float)


def _check_exponent(node: ast.expr) -> None:
    sign = node.operand if isinstance(node, ast.UnaryOp) else node
    if isinstance(sign, ast.Constant) and isinstance(sign.value, int | float) and abs(sign.value) > MAX_EXPONENT:
        raise _Refused(f"has the exponent {sign.value:g}; the largest is {MAX_EXPONENT}")


def _unknown(kind: str, name: str, known: list[str]) -> str:
    near = difflib.get_close_matches(name, known, 1)
    hint = f"did you mean '{near[0]}'? Known" if near else "known"
    return f"unknown {kind} '{name[:40]}'; {hint} are {', '.join(known)}"
