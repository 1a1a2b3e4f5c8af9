"""Notebooks: files without outputs, with short cells; and what the site shows of them when it runs them."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from lyapnet.claims.tables import table_of, text_of
from tests.pages import NOTEBOOKS, ROOT, cells_of
from tests.test_docs import FENCED, WIDTH

LONGEST = 32  # lines of a cell; a class takes most of them
EXPECTED = {  # number of drawings and figures ↦ at least, and what the outputs say
    "double_integrator": (2, ["cost_ratio +1.00", "satisfied_fraction +1.0000", "statistical: certified"]),
    "own_plant": (2, ["this law +1.00", "verified: on 10000 states", r"in 100 steps: \d.\de-1\d A²"]),
    "families": (3, ["cost / optimum 1.00", "unseen states and weights: cost / optimum 1.0"]),
    "certificates": (2, ["volume of the region, at least +17", "check: certified", "check: refused", "unknown"]),
}


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_outputs_in_one_form(notebook):
    text = notebook.read_text(encoding="utf-8")
    content = json.loads(text)
    assert text == json.dumps(content, ensure_ascii=False, indent=1, sort_keys=True) + "\n"
    code = [cell for cell in content["cells"] if cell["cell_type"] == "code"]
    assert not [cell["id"] for cell in code if cell["outputs"] or cell["execution_count"]], "clear all outputs"
    assert content["metadata"]["kernelspec"]["name"] == "python3"


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_cells_are_short_and_wrapped(notebook):
    assert max(len(cell.splitlines()) for cell in cells_of(notebook, "code")) <= LONGEST
    lines = [line for cell in cells_of(notebook, "markdown") for line in FENCED.sub("", cell).splitlines()]
    assert not [line for line in lines if len(line) > WIDTH]


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_axes_have_labels_with_units(notebook):
    code = "\n".join(cells_of(notebook, "code"))
    labels = re.findall(r'[xy]label="([^"]+)"', code)
    assert len(re.findall(r"plt\.subplots", code)) <= len(labels)
    assert not [label for label in labels if not re.search(r"\(.+\)|cost", label)]


def test_a_table_has_no_control_characters_in_a_notebook(monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # as a notebook's kernel has it
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    text = text_of(table_of("title", [("label", "1")]))
    assert "title" in text
    assert "\x1b" not in text


def site_with(notebook: Path, folder: Path) -> subprocess.CompletedProcess:
    """The site of one notebook, which is run, with the settings of docs/conf.py; links to other pages lead nowhere."""
    pages = folder / "pages"
    (pages / "notebooks").mkdir(parents=True)
    shutil.copy(notebook, pages / "notebooks")
    (pages / "index.md").write_text(f"# Site\n\n```{{toctree}}\nnotebooks/{notebook.stem}\n```\n")
    options = ["-D", "nb_execution_mode=force", "-D", "suppress_warnings=myst.xref_missing"]
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "-c", str(ROOT / "docs"), *options, str(pages)]
    return subprocess.run([*command, str(folder / "site")], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_page_offers_the_file_and_says_whether_it_was_run(notebook, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs" / "_extensions")
    from notebook_pages import NOT_RUN, with_download  # pyright: ignore[reportMissingImports]

    for mode in ("off", "force"):
        source = [notebook.read_text(encoding="utf-8")]
        app = SimpleNamespace(config=SimpleNamespace(nb_execution_mode=mode))
        with_download(app, f"notebooks/{notebook.stem}", source)
        first = "".join(json.loads(source[0])["cells"][0]["source"])
        assert f"`{notebook.name}`" in first
        assert (NOT_RUN in first) == (mode == "off")
    other = ["# A page\n"]
    with_download(app, "notation", other)
    assert other == ["# A page\n"]


@pytest.mark.gate
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_the_site_shows_what_it_printed(notebook, tmp_path):
    pytest.importorskip("myst_nb")
    built = site_with(notebook, tmp_path)
    assert built.returncode == 0, built.stderr
    page = (tmp_path / "site" / "notebooks" / f"{notebook.stem}.html").read_text(encoding="utf-8")
    pictures, sentences = EXPECTED[notebook.stem]
    assert len(list((tmp_path / "site" / "_images").glob("*.png"))) + page.count("<title>Closed loops") >= pictures
    assert "white-space:pre" not in page, "progress is plain text, in one output"
    text = re.sub(r"<[^>]+>", "", page)
    assert not [sentence for sentence in sentences if not re.search(sentence, text)]
    assert f"{notebook.name}</span>, without outputs" in re.sub(r"</?code[^>]*>|</?a[^>]*>", "", page)


@pytest.mark.gate
@pytest.mark.parametrize("works", [True, False])
def test_a_cell_that_raises_fails_the_site(works, tmp_path):
    pytest.importorskip("myst_nb")
    content = json.loads(NOTEBOOKS[0].read_text(encoding="utf-8"))
    content["cells"] = [cell for cell in content["cells"] if cell["id"] in ("title", "wrong")]
    code = {"cell_type": "code", "execution_count": None, "id": "wrong", "metadata": {}, "outputs": []}
    content["cells"].append(code | {"source": ["print(7 * 191)\n", f"assert {works}"]})
    (tmp_path / "some.ipynb").write_text(json.dumps(content))
    built = site_with(tmp_path / "some.ipynb", tmp_path)
    assert (built.returncode == 0) == works
    if works:
        assert "1337" in (tmp_path / "site" / "notebooks" / "some.html").read_text(encoding="utf-8")
    else:
        assert "AssertionError" in built.stderr
