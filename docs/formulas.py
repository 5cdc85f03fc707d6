"""Formulas as MathML, which browsers show without a script and without the network, and a font for them: few systems have one.

The font is STIX Two Math (SIL Open Font License), as the package ziamath brings it.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.util.fileutil import copy_asset
from sphinx.writers.html5 import HTML5Translator

LOG = logging.getLogger(__name__)
FONT = resources.files("ziamath") / "fonts" / "STIXTwoMath-Regular.ttf"


def setup(app: Sphinx) -> dict[str, bool]:
    """Make "mathml" a renderer that ``html_math_renderer`` may name."""
    app.add_html_math_renderer("mathml", (write_inline, None), (write_block, None))
    app.connect("build-finished", copy_font)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def copy_font(app: Sphinx, exception: Exception | None) -> None:
    """Put the font beside the styles that name it."""
    if exception is None and app.builder.format == "html":
        copy_asset(str(FONT), str(Path(app.outdir) / "_static"), force=True)


def write_inline(writer: HTML5Translator, node: nodes.math) -> None:
    """A formula in a line."""
    writer.body.append(mathml(node, as_block=False))
    raise nodes.SkipNode


def write_block(writer: HTML5Translator, node: nodes.math_block) -> None:
    """A formula of its own, in a frame that is scrolled where the window is narrower."""
    writer.body.append(f'<div class="formula">{mathml(node, as_block=True)}</div>')
    raise nodes.SkipNode


def mathml(node: nodes.math | nodes.math_block, as_block: bool) -> str:
    """A formula of LaTeX as MathML; one that cannot be read is a warning, which a build with -W fails by."""
    try:
        return tex2mathml(node.astext().strip(), as_block=as_block)
    except MathError as error:
        LOG.warning("formula %r: %s", node.astext(), error, location=node)
        return ""
