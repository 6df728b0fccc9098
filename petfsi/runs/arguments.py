"""What the words of a command line are: petfsi's own options, PETSc's, and times."""

from __future__ import annotations

import re
from typing import Any

import click

_OPTION = re.compile(r"--?[A-Za-z]")


class SolverCommand(click.Command):
    """A command whose words with one dash belong to PETSc, each with the value behind it."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Take PETSc's options out, then parse the rest as click does."""
        own, petsc = self._split(ctx, args)
        ctx.meta["petsc"] = petsc
        try:
            return super().parse_args(ctx, own)
        except click.MissingParameter as error:
            if not petsc:
                raise
            hint = "Give it before the PETSc options: a word that follows one of them is its value."
            raise click.UsageError(f"{error.format_message()} {hint}", ctx) from None

    def collect_usage_pieces(self, ctx: click.Context) -> list[str]:
        """Put the arguments first, as they must stand before PETSc's options."""
        arguments = [p.make_metavar(ctx) for p in self.get_params(ctx) if isinstance(p, click.Argument)]
        return [*arguments, "[OPTIONS]", "[PETSc options]..."]

    def _split(self, ctx: click.Context, args: list[str]) -> tuple[list[str], list[str]]:
        flags = {name: getattr(p, "is_flag", False) for p in self.get_params(ctx) for name in p.opts}
        own: list[str] = []
        petsc: list[str] = []
        words = list(reversed(args))
        while words:
            word = words.pop()
            if word == "-h":
                own.append("--help")
            elif f"-{word}" in flags and not word.startswith("--"):
                raise click.UsageError(f"'{word}': petfsi's own options have two dashes: -{word}", ctx)
            elif re.match(r"-[A-Za-z]", word):
                petsc.append(word)
                if words and not _OPTION.match(words[-1]):
                    petsc.append(words.pop())
            else:
                own.append(word)
                if flags.get(word) is False and words:
                    own.append(words.pop())
        return own, petsc


class Seconds(click.types.FloatParamType):
    """A time: a number."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return it; what is no number is within no range, and passes for one."""
        found = super().convert(value, param, ctx)
        if found != found:
            self.fail(f"{value!r} is no number", param, ctx)
        return found


class Duration(Seconds, click.FloatRange):
    """A time within a range."""
