"""How Sphinx builds these pages: `sphinx-build -W docs docs/_build`, after `pip install "mivol[docs]"`."""

project = "mivol"
author = "The mivol authors"
extensions = ["myst_parser"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "mivol"
html_show_copyright = False
