"""What the site adds to a notebook: the file to download, and a line where it was not run."""

import json
from typing import Any

from sphinx.application import Sphinx

DOWNLOAD = "Download {{download}}`{name}.ipynb`, without outputs."
NOT_RUN = " **This site was built without running it:** there are no outputs below."


def with_download(app: Sphinx, docname: str, source: list[str]) -> None:
    """The text of a notebook with a link to its file behind its introduction."""
    folder, _, name = docname.rpartition("/")
    if folder == "notebooks":
        notebook = json.loads(source[0])
        line = DOWNLOAD.format(name=name) + NOT_RUN * (app.config.nb_execution_mode == "off")
        notebook["cells"][0]["source"] += ["\n\n", line]
        source[0] = json.dumps(notebook)


def setup(app: Sphinx) -> dict[str, Any]:
    """The extension, for Sphinx."""
    app.connect("source-read", with_download)
    return {"parallel_read_safe": True}
