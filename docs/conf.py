"""Sphinx configuration: ``sphinx-build -W -b html docs docs/_build``."""

from importlib.metadata import version as _version

from sphinx.util.inspect import signature as _signature
from sphinx.util.inspect import stringify_signature

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


def _show_own_signature(app, what, name, obj, options, signature, return_annotation):
    """Show what a class takes where a base class or metaclass hides it behind ``*args``."""
    if what == "class" and (signature or "").startswith("(*args") and "__init__" in vars(obj):
        signature = stringify_signature(_signature(obj.__init__, bound_method=True))
    return signature, return_annotation


def setup(app):
    """Connect the handler above."""
    app.connect("autodoc-process-signature", _show_own_signature)
