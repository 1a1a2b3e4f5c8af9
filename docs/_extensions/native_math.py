"""Formulas as MathML, which browsers draw themselves: the site needs no script and no network for them.

A page writes them as Git hosts read them: $…$ in a sentence, a block called math for an equation, with \\tag{1} for its
number.
"""

import re
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util import logging

TAG = re.compile(r"\\tag\{(\w+)\}")
NOT_CONVERTED = re.compile(r">(\\\w+|&)<")
_LOG = logging.getLogger(__name__)


def numbered(latex: str) -> tuple[str, str | None]:
    """A formula without its tag, and the tag."""
    tag = TAG.search(latex)
    return TAG.sub("", latex).strip(), tag and tag[1]


def not_converted(mathml: str) -> list[str]:
    """The commands that the converter left as text."""
    return NOT_CONVERTED.findall(mathml)


def _mathml(latex: str, display: str, node: nodes.Node) -> str:
    mathml = convert(latex, display=display)
    if left := not_converted(mathml):
        _LOG.warning("Expected LaTeX that becomes MathML, got %s in %s", ", ".join(left), latex, location=node)
    return mathml


def in_line(translator: Any, node: nodes.math) -> None:
    """A formula in a sentence."""
    translator.body.append(_mathml(node.astext(), "inline", node))
    raise nodes.SkipNode


def block(translator: Any, node: nodes.math_block) -> None:
    """An equation on a line of its own, its number on the right."""
    latex, number = numbered(node.astext())
    name, shown = (f' id="equation-{number}"', f"<span>({number})</span>") if number else ("", "")
    translator.body.append(f'<div class="equation"{name}>{_mathml(latex, "block", node)}{shown}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    """The extension, for Sphinx."""
    app.add_html_math_renderer("mathml", (in_line, None), (block, None))
    return {"parallel_read_safe": True}
