"""Docstrings as they read in the code: plain text with Unicode formulas, where *batch, |x| and V_ are no markup."""

import re
from typing import Any

from sphinx.application import Sphinx

MARKUP = re.compile(r"([`|\\]|\*(?!\s)|_(?!\w))")


def escape(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """The lines of a docstring without anything that reStructuredText takes for markup, sections aside."""
    lines[:] = [MARKUP.sub(r"\\\1", line) for line in lines]
    if what in ("attribute", "property"):
        lines[:0] = ["\\ "]  # napoleon takes what stands before a colon in the first line for a type


def setup(app: Sphinx) -> dict[str, Any]:
    """The extension, for Sphinx."""
    app.connect("autodoc-process-docstring", escape, priority=400)  # before napoleon's 500
    return {"parallel_read_safe": True}
