"""Formulas as MathML, which browsers show without any script, from LaTeX by latex2mathml."""

from html import escape
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.util.math import get_node_equation_number


def formula(latex: str, *, display: str) -> str:
    """The ``<math>`` element of a formula; the LaTeX is its title, for readers who want to copy
    it."""
    element = convert(latex, display=display)
    return element.replace("<math ", f'<math title="{escape(latex, quote=True)}" ', 1)


def visit_math(writer: Any, node: nodes.math) -> None:
    writer.body.append(formula(node.astext(), display="inline"))
    raise nodes.SkipNode


def visit_math_block(writer: Any, node: nodes.math_block) -> None:
    writer.body.append(writer.starttag(node, "div", CLASS="math"))
    if node.get("number"):
        number = get_node_equation_number(writer, node)
        writer.body.append(f'<span class="eqno">({number})</span>')
    writer.body.append(formula(node.astext(), display="block"))
    writer.body.append("</div>\n")
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, bool]:
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_math_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
