"""The README and the pages under docs/, as the tests of what they say read them."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
PAGES = {path: path.read_text(encoding="utf-8") for path in (README, *sorted((ROOT / "docs").glob("*.md")))}
REPORT = ROOT / "docs" / "compare" / "report.md"  # written by lyapnet compare


def blocks(language: str) -> list[str]:
    """The code blocks of a language on all pages, in their order."""
    return [block for text in PAGES.values() for block in re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)]
