"""Sphinx configuration: ``sphinx-build -W docs build/site`` makes the site, without the network.

The tutorials of ``examples/`` are run while it builds, at reduced size unless ``GLINTRACK_DOCS_FULL`` is 1.
"""

import os
import sys
from importlib.metadata import version as installed_version
from pathlib import Path

import matplotlib

sys.path.insert(0, str(Path(__file__).parent / "_ext"))
matplotlib.use("Agg")

project = "glintrack"
author = "the glintrack contributors"
copyright = "2026, the glintrack contributors, BSD 3-Clause"
version = release = installed_version("glintrack")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
    "docstrings",
    "reference_pages",
]
exclude_patterns = ["_ext", "tutorials/*.py", "tutorials/*.ipynb"]
suppress_warnings = ["config.cache"]  # the gallery's sort keys are classes

html_theme = "furo"
html_title = "glintrack"
templates_path = ["_templates"]
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_copy_source = False
html_theme_options = {"source_edit_link": ""}

myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence", "deflist"]

autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True, "show-inheritance": False}
napoleon_google_docstring = False

os.environ.setdefault("XDG_CACHE_HOME", str(Path.home() / ".cache"))  # solved tables outlive a build
sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "tutorials",
    "filename_pattern": r"/\d\d_",
    "within_subsection_order": "FileNameSortKey",
    "download_all_examples": False,
    "capture_repr": ("_repr_html_",),
    "show_memory": False,
    "write_computation_times": False,  # a page that loads scripts from elsewhere
    "show_signature": False,
    "remove_config_comments": True,
    "abort_on_example_error": True,
    "image_srcset": ["2x"],
    "default_thumb_file": None,
}
