"""Settings of the documentation site: python -m sphinx -W -b html docs docs/_build/html"""

from __future__ import annotations

import importlib.metadata
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

import make_api

make_api.PAGE.write_text(make_api.page(), encoding="utf-8")

project = "fpirhc"
author = "The fpirhc authors"
copyright = author
release = importlib.metadata.version("fpirhc")
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinxcontrib.katex",
    "sphinx_gallery.gen_gallery",
    "plain_docstrings",
    "framed_pictures",
]
exclude_patterns = ["_build", "gallery_src/README.rst"]
html_theme = "furo"
html_title = f"fpirhc {release}"
# Offline like the reports: KaTeX's script comes with its extension, its style sheet and fonts stand in _static/katex. Both are of
# version 0.16.22 of KaTeX; the style sheet names the fonts in the one format that every browser reads.
html_static_path = ["_static"]
katex_css_path = "katex/katex.min.css"
html_css_files = ["gallery.css"]
katex_options = "throwOnError: true"
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "none"
napoleon_use_param = False
napoleon_use_rtype = False
sphinx_gallery_conf = {
    "examples_dirs": "gallery_src",
    "gallery_dirs": "gallery",
    "filename_pattern": "/plot_",
    "download_all_examples": False,
    "show_memory": False,
    "capture_repr": ("_repr_html_",),  # and not the names of matplotlib's objects
    "write_computation_times": False,  # its page would load scripts from elsewhere
    "abort_on_example_error": True,
    "only_warn_on_example_error": False,
    "plot_gallery": True,
    "parallel": 2,
    "remove_config_comments": True,
}
