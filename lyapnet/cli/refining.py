"""What the commands that refine share: certify, train on with what failed, certify again."""

from collections.abc import Callable
from typing import Any

from rich.console import Console

from lyapnet.base.errors import UsageError
from lyapnet.cli.options import Given


def require_refinable(rounds: int, overrides: list[str] | None, keep: str | None, given: Given) -> None:
    """Refuse what does not go with --refine, and overrides without it."""
    if rounds and keep is not None:
        raise UsageError("Expected --keep or --refine, got both; each round proves something about another V.")
    if rounds and given.at:
        raise UsageError("Expected --at or --refine, got both; training goes on with the whole family.")
    if overrides and not rounds:
        raise UsageError(f"Expected overrides with --refine ROUNDS, got {' '.join(overrides)!r}; add it.")


def refined(
    given: Given, certified: Callable[..., Any], rounds: int, overrides: list[str] | None, begun: float
) -> tuple[Given, Any]:
    """The controller and its certificate, after so many rounds of training at most."""
    if not rounds:
        return given, certified(given.checkpoint, begun)
    from lyapnet.training.refinement import refine

    notes = Console(stderr=True, highlight=False, markup=False)
    checkpoint, certificate = refine(given.checkpoint, certified, rounds, overrides or [], notes, given.parts())
    return given.of(checkpoint), certificate
