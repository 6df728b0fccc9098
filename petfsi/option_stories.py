"""What PETSc's errors about options mean, for those who wrote the options."""

from __future__ import annotations

from petsc4py import PETSc


def petsc_text(error: PETSc.Error) -> str:
    """Return the last words of a PETSc error: what it said, without where in PETSc."""
    lines = [line.split("]", 1)[-1].strip() for line in str(error).splitlines()]
    return next((line for line in reversed(lines) if line and "()" not in line), f"error code {error.ierr}")


def option_story(prefix: str, error: PETSc.Error) -> str:
    """Return which option of a solver PETSc could not follow, and why."""
    text = petsc_text(error).rstrip(".")
    option = " or ".join(_options_meant(text, prefix)) or f"-{prefix}..."
    hint = "; all of the matrix can be factorised with -fsi_mat_type aij" if "type nest" in text else ""
    return f"option {option}: PETSc cannot set this solver up: {text}{hint} (code {error.ierr})"


def _options_meant(text: str, prefix: str) -> list[str]:
    """Return the options that a PETSc message speaks of; most name the value only."""
    words = {word.rstrip(".,") for word in text.split()}
    values = PETSc.Options().getAll()
    options = {f"-{name}": value for name, value in sorted(values.items()) if name.startswith(prefix)}
    kind = next((f"_{kind.lower()}_type" for kind in ("KSP", "PC") if f"{kind} type" in text), "")
    named = [name for name in options if name in words]
    return [f"{name} {options[name]}" for name in named] or [
        f"{name} {value}" for name, value in options.items() if value in words and name.endswith(kind)
    ]
