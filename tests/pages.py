"""The README and the pages under docs/, as the tests of what they say read them."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
PAGES = {path: path.read_text(encoding="utf-8") for path in (README, *sorted((ROOT / "docs").glob("*.md")))}
REPORT = ROOT / "docs" / "compare" / "report.md"  # written by lyapnet compare


def blocks(language: str, *pages: Path) -> list[str]:
    """The code blocks of a language on these pages, or on all, in their order."""
    texts = [PAGES[page] for page in pages or PAGES]
    return [block for text in texts for block in re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)]
