"""What is said of a claim in the end."""

from typing import Literal

Verdict = Literal["certified", "falsified", "unknown"]
