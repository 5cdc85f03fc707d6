"""How Sphinx builds these pages: `sphinx-build -W docs docs/_build`, after `pip install "mivol[docs]"`."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

project = "mivol"
author = "The mivol authors"
extensions = ["myst_nb", "formulas"]
# Notebooks are kept without outputs. .github/workflows/docs.yml executes them, with -D nb_execution_mode=force.
nb_execution_mode = "off"
nb_execution_timeout = 300
nb_execution_raise_on_error = True
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
# A flag outside of code, --look-at, is copied as it stands.
smartquotes = False
exclude_patterns = ["_build"]
html_math_renderer = "mathml"
html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["wide.css"]
html_title = "mivol"
html_show_copyright = False
