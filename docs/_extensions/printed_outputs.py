"""What the cells of a tutorial printed when its page was written: text blocks, and pictures called printed_….png.

A site whose tutorials are run has the outputs of its own machine instead.
"""

import re
from typing import Any

from sphinx.application import Sphinx

PRINTED = re.compile(r"```text\n.*?\n```\n\n?|!\[[^]]*\]\(printed_\w+\.png\)\n\n?", re.DOTALL)


def without_printed(app: Sphinx, docname: str, source: list[str]) -> None:
    """The text of a tutorial whose cells are run, without what they printed before."""
    if docname.startswith("tutorials/") and app.config.nb_execution_mode != "off":
        source[0] = PRINTED.sub("", source[0])


def setup(app: Sphinx) -> dict[str, Any]:
    """The extension, for Sphinx."""
    app.connect("source-read", without_printed)
    return {"parallel_read_safe": True}
