"""The documentation site: what it needs from elsewhere, that its figures are on record, and that its tutorials run."""

import ast
import csv
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.links import broken_links
from tests.pages import NOTEBOOKS, ROOT

DOCS = ROOT / "docs"
LEADERBOARD = DOCS / "leaderboard.md"
FIGURE = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?![\w.])")


def rows(page: str) -> list[tuple[str, str]]:
    """Figures of a row of the leaderboard, as text, and the file that it names as their source."""
    found = []
    for line in page.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split(" |")]
        sources = [place for place, cell in enumerate(cells) if re.fullmatch(r"\[[\w.]+\]\([^)]+\)", cell)]
        if line.startswith("| ") and sources:
            found.append((" ".join(cells[1 : sources[0]]), re.findall(r"\]\(([^)#]+)", cells[sources[0]])[0]))
    return found


def on_record(source: Path) -> set[str]:
    """The figures of a page, or those of a comparison's table as the leaderboard rounds them."""
    text = source.read_text(encoding="utf-8")
    if source.suffix != ".csv":
        return {*FIGURE.findall(text)}
    lines = list(csv.DictReader(text.splitlines()))
    costs = {f"{float(line['cost_ratio']):.{digits}f}" for line in lines for digits in (2, 4)}
    return costs | {f"{float(line['seconds_mean']):.0f}" for line in lines}


def missing(page: str) -> list[str]:
    return [figure for cells, source in rows(page) for figure in set(FIGURE.findall(cells)) - on_record(DOCS / source)]


def test_every_figure_of_the_leaderboard_is_in_the_file_that_its_row_names():
    page = LEADERBOARD.read_text(encoding="utf-8")
    assert sum(len(FIGURE.findall(cells)) for cells, _ in rows(page)) >= 100
    assert missing(page) == []
    assert missing(page.replace("| 1.0654 (", "| 1.0653 (")) == ["1.0653"]


def on_the_sidebar() -> set[str]:
    trees = re.findall(r"```\{toctree\}\n(.*?)```", (DOCS / "index.md").read_text(encoding="utf-8"), re.DOTALL)
    return {line for tree in trees for line in tree.splitlines() if line and not line.startswith((":", "Start "))}


def test_every_page_is_on_the_sidebar():
    tables = {"compare/table1", "compare/details"}  # of the report, to download
    pages = {path.relative_to(DOCS).with_suffix("").as_posix() for path in (*DOCS.glob("**/*.md"), *NOTEBOOKS)}
    assert on_the_sidebar() == pages - {"index"} - tables


def test_the_reference_has_the_public_interface():
    import lyapnet

    shown = re.findall(r"^\.\. auto\w+:: (\w+)$", (DOCS / "reference.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(shown) == sorted({*lyapnet.__all__} - {"SYSTEMS", "__version__"})


def test_links_that_lead_nowhere_are_found(tmp_path):
    there = '<p id="here"><a href="#here"></a><a href="sub/b.html#x y"></a><a href="https://example.org/none"></a>'
    (tmp_path / "a.html").write_text(there)
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "b.html").write_text('<h1 id="x y"><img src="../picture.png"><a href="../a.html#here"></a>')
    (tmp_path / "picture.png").touch()
    assert broken_links(tmp_path) == []
    (tmp_path / "a.html").write_text(there.replace('id="here"', ""))
    (tmp_path / "picture.png").unlink()
    assert broken_links(tmp_path) == ["a.html: #here", "sub/b.html: ../a.html#here", "sub/b.html: ../picture.png"]


def silent_cells(page: str) -> list[str]:
    """The cells of a tutorial that print or end in an expression, without what they printed behind them."""
    cells = re.findall(r"```\{code-cell\} ipython3\n(.*?)```\n\n?(```text\n|!\[)?", page, re.DOTALL)
    return [cell for cell, printed in cells if shows(cell) and not printed]


def shows(cell: str) -> bool:
    if re.search(r"^!|\bprint\(|\.train\(|\.fit\(", re.sub(r'""".*?"""', "", cell, flags=re.DOTALL), re.MULTILINE):
        return True
    code = "\n".join(line for line in cell.splitlines() if not line.startswith(("%", ":")))
    return isinstance(ast.parse(code).body[-1], ast.Expr)


TUTORIALS = [page for page in sorted((DOCS / "tutorials").glob("*.md")) if "{code-cell}" in page.read_text("utf-8")]


@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_a_tutorial_says_what_its_cells_printed(page):
    text = page.read_text(encoding="utf-8")
    assert silent_cells(text) == []
    last = re.findall(r"```text\n.*?\n```\n", text, re.DOTALL)[-1]
    assert len(silent_cells(text.replace(last, ""))) == 1


def test_tutorials_that_are_run_lose_what_they_printed_before(monkeypatch):
    monkeypatch.syspath_prepend(DOCS / "_extensions")
    from printed_outputs import without_printed  # pyright: ignore[reportMissingImports]

    for page in TUTORIALS:
        text = page.read_text(encoding="utf-8")
        for mode, kept in (("off", True), ("force", False)):
            app, source = SimpleNamespace(config=SimpleNamespace(nb_execution_mode=mode)), [text]
            without_printed(app, f"tutorials/{page.stem}", source)
            assert ("```text" in source[0], "printed_" in source[0]) == (kept, kept and "printed_" in text)
            assert source[0].count("{code-cell}") == text.count("{code-cell}")
            assert source[0].count("```") % 2 == 0


@pytest.mark.nightly
def test_the_site_builds_with_its_tutorials_executed_and_needs_no_network(tmp_path):
    pytest.importorskip("myst_nb")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "-D", "nb_execution_mode=force", str(DOCS), str(tmp_path)]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    loaded = r"<(?:script|img|iframe)[^>]* src=\"(?:https?:)?//|<link[^>]*stylesheet[^>]*href=\"(?:https?:)?//"
    assert broken_links(tmp_path) == []
    assert re.search(loaded, '<script async src="https://cdn.example.org/mathjax.js">')
    assert not [page for page in tmp_path.rglob("*.html") if re.search(loaded, page.read_text(encoding="utf-8"))]
    assert not list(tmp_path.rglob("printed_*")), "the outputs are those of this run"
