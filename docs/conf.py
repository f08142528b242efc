"""Sphinx configuration: ``sphinx-build -W -b html docs docs/_build``."""

from importlib.metadata import version as _version

project = "warmprior"
author = "the warmprior developers"
release = version = _version("warmprior")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.doctest",
    "sphinx.ext.viewcode",
]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "warmprior"

# The reference shows what each package lists in __all__, in that order, without what its classes
# inherit: TorchRL documents its own methods.
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_inherit_docstrings = False
# A dataclass field would otherwise be described twice: by its class and by itself.
napoleon_use_ivar = True
toc_object_entries_show_parents = "hide"

# The docstrings' examples are run by pytest.
doctest_test_doctest_blocks = ""
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3
