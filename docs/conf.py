"""The documentation site: sphinx-build -W docs build/site."""

import sys
from importlib.metadata import version as installed_version
from pathlib import Path

sys.path[:0] = [str(Path(__file__).parent / "_extensions"), str(Path(__file__).parents[1])]

project = "lyapnet"
author = "The lyapnet authors"
version = release = installed_version("lyapnet")

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "repository_links",
    "plain_docstrings",
    "printed_outputs",
    "native_math",
    "notebook_pages",
]
exclude_patterns = ["_extensions", "compare/details.md", "compare/table1.md"]  # the report's tables are downloads

myst_heading_anchors = 3  # the anchors of Git hosts, which the pages link to
myst_enable_extensions = ["fieldlist", "dollarmath"]
myst_fence_as_directive = ["math"]  # as on Git hosts
nb_execution_mode = "off"  # for a quick look; the published site has -D nb_execution_mode=force
nb_execution_in_temp = True
nb_execution_timeout = 600
nb_execution_show_tb = True  # of a cell that fails, in the warning that -W makes an error
nb_merge_streams = True

autosummary_generate = False  # one page holds them all
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100

html_theme = "furo"
html_title = f"lyapnet {version}"
html_static_path = ["_static"]
templates_path = ["_templates"]
html_sidebars = {
    "**": [
        "sidebar/brand.html",
        "sidebar/search.html",
        "sidebar/scroll-start.html",
        "sidebar/navigation.html",
        "sidebar/versions.html",  # with sphinx-build -A versions="main v0.3.0", as .github/workflows/site.yml has it
        "sidebar/scroll-end.html",
    ]
}
html_css_files = ["tables.css", "formulas.css"]
html_math_renderer = "mathml"
html_show_sphinx = False
html_show_copyright = False
