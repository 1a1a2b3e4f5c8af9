"""What is found out about a problem once, for it and all its copies."""

from typing import Any


class Findings(dict[str, Any]):
    """Facts about the functions of a problem, by name, and programs that were written of them in this process."""

    programs: dict[Any, Any]

    def __init__(self, *facts: Any, **named: Any):
        super().__init__(*facts, **named)
        self.programs = {}

    def __deepcopy__(self, memo: dict[int, Any]) -> "Findings":
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        return Findings, (dict(self),)
