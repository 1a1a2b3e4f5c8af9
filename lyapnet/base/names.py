"""Names of states, controls, parameters and joints in configs, equations and files."""

import re
from typing import Any


def with_underscores(name: Any) -> str:
    """A name with _ for spaces, as configs and equations write it."""
    return str(name).replace(" ", "_")


def identifier(name: str, kind: str = "joint") -> str:
    """A name with _ for all but letters and digits, with its kind in front if it does not begin with a letter."""
    text = re.sub(r"\W", "_", name)
    return text if text[:1].isalpha() else f"{kind}_{text}"
