"""How Sphinx builds the documentation; see CONTRIBUTING.md."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from napari_shadowinv import __version__

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_ext"))

project = "napari-shadowinv"
author = "The napari-shadowinv contributors"
project_copyright = author
version = release = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "numpydoc",
    "reference_pages",
]
exclude_patterns = ["_build", "_ext", "_static", "_templates"]
templates_path = ["_templates"]

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3

autodoc_typehints = "none"  # the docstrings tell types, shapes and units
autosummary_generate = True
autosummary_ignore_module_all = False
smartquotes = False  # two hyphens are a flag
default_role = "py:obj"
numpydoc_show_class_members = False
numpydoc_validation_checks: set[str] = set()

html_theme = "pydata_sphinx_theme"
html_title = project
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "header_links_before_dropdown": 7,
    "navigation_with_keys": False,
    "navbar_end": ["theme-switcher"],
    "show_prev_next": True,
    "footer_start": ["copyright"],
    "footer_end": [],
}
html_sidebars = {"start": [], "trust": [], "changelog": []}

if os.environ.get("GALLERY") == "1":
    from gallery import sphinx_gallery_conf  # noqa: F401

    extensions.append("sphinx_gallery.gen_gallery")
else:
    exclude_patterns.append("examples")
