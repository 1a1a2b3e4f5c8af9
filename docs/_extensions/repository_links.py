"""Links that pages write for the repository, made to work on the site.

README.md and CHANGELOG.md stand beside docs/ in the repository; on the site they are the pages that include them. The
two tables of a comparison that are Markdown without a heading are files to download, as MyST makes of every other file
that a page links to, a config or a module.
"""

import re
from typing import Any

from sphinx.application import Sphinx

PAGES = {"README.md": "index.md", "CHANGELOG.md": "changelog.md"}
TABLE = re.compile(r"\[(\w+)\]\((compare/(?:table1|details)\.md)\)")


def for_the_site(app: Sphinx, docname: str, source: list[str]) -> None:
    """The text of a page with the links that the site needs."""
    up = "../" * docname.count("/")
    for file, page in PAGES.items():
        source[0] = source[0].replace(f"](../{up}{file}", f"]({up}{page}")
    source[0] = TABLE.sub(r"{download}`\1 <\2>`", source[0])


def setup(app: Sphinx) -> dict[str, Any]:
    """The extension, for Sphinx."""
    app.connect("source-read", for_the_site)
    return {"parallel_read_safe": True}
