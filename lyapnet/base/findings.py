"""Cached facts about a problem, shared by all its copies."""

from typing import Any


class Findings(dict[str, Any]):
    """Facts about the functions of a problem by name, and the compiled programs of these functions."""

    programs: dict[Any, Any]

    def __init__(self, *facts: Any, **named: Any):
        super().__init__(*facts, **named)
        self.programs = {}

    def __deepcopy__(self, memo: dict[int, Any]) -> "Findings":
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return Findings, (dict(self),)
