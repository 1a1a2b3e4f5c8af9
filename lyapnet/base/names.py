"""Names of states, controls, parameters and joints as texts write them."""

import re
from typing import Any


def joined(name: Any) -> str:
    """A name with _ for its spaces, by which configs and equations write it."""
    return str(name).replace(" ", "_")


def identifier(name: str, kind: str = "joint") -> str:
    """A name of letters, digits and _, as of a joint in a file; its kind comes first if no letter does."""
    text = re.sub(r"\W", "_", name)
    return text if text[:1].isalpha() else f"{kind}_{text}"
