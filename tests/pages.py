"""The README and the pages under docs/, as the tests of what they say read them."""

import json
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
PAGES = {path: path.read_text(encoding="utf-8") for path in (README, *sorted((ROOT / "docs").glob("*.md")))}
REPORT = ROOT / "docs" / "compare" / "report.md"  # written by lyapnet compare


NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


def cells_of(notebook: Path, kind: str) -> list[str]:
    """The text of each cell of a notebook that is code, or markdown."""
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == kind]


def prose_of(page: Path) -> str:
    """The Markdown of a page or of a notebook."""
    if page.suffix == ".ipynb":
        return "\n\n".join(cells_of(page, "markdown"))
    return page.read_text(encoding="utf-8")


def blocks(language: str, *pages: Path) -> list[str]:
    """The code blocks of a language on these pages, or on all, in their order."""
    texts = [PAGES[page] for page in pages or PAGES]
    return [block for text in texts for block in re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)]
