"""Names of states, controls, parameters and joints as texts write them."""

import re
from typing import Any


def joined(name: Any) -> str:
    """A name with _ for its spaces, by which configs and equations write it."""
    return str(name).replace(" ", "_")


def identifier(name: str) -> str:
    """A name of letters, digits and _, of a joint or motor in a robot's file."""
    text = re.sub(r"\W", "_", name)
    return text if text[:1].isalpha() else f"joint_{text}"
