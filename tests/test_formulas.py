"""Formulas of the pages as the site shows them: each becomes MathML, and equations are numbered in their order."""

import re

import pytest

from tests.pages import PAGES, ROOT, blocks

THEORY = ROOT / "docs" / "theory.md"
INLINE = re.compile(r"\$([^$`]+)\$")


@pytest.fixture
def native_math(monkeypatch):
    pytest.importorskip("latex2mathml")
    monkeypatch.syspath_prepend(ROOT / "docs" / "_extensions")
    return __import__("native_math")


def test_every_formula_becomes_mathml(native_math):
    prose = re.sub(r"^```.*?^```$", "", PAGES[THEORY], flags=re.DOTALL | re.MULTILINE)
    formulas = [native_math.numbered(block)[0] for block in blocks("math", THEORY)] + INLINE.findall(prose)
    assert len(formulas) > 100
    assert [f for f in formulas if native_math.not_converted(native_math.convert(f))] == []
    assert native_math.not_converted(native_math.convert(r"a \unknown b")) == [r"\unknown"]


def test_equations_are_numbered_in_their_order():
    tags = re.findall(r"\\tag\{(\w+)\}", PAGES[THEORY])
    assert tags == [str(k + 1) for k in range(len(tags))]
    prose = re.sub(r"\\tag\{\w+\}", "", PAGES[THEORY])
    assert {*re.findall(r"(?<![\w^}])\((\d+)\)", prose)} <= {*tags}


def escapes(page: str) -> list[str]:
    """Formulas in sentences with a backslash that Markdown may take for its own, as some Git hosts do."""
    prose = re.sub(r"^```.*?^```$", "", page, flags=re.DOTALL | re.MULTILINE)
    return [formula for formula in INLINE.findall(prose) if re.search(r"\\[^A-Za-z]", formula)]


def test_formulas_in_sentences_have_no_escapes():
    assert escapes(PAGES[THEORY]) == []
    assert escapes(r"the set $\{x\}$") == [r"\{x\}"]
