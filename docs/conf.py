"""Sphinx configuration: ``sphinx-build -W -b html docs docs/_build``."""

import re
import sys as _sys
import warnings as _warnings
from functools import cache as _cache
from importlib.metadata import metadata as _metadata
from pathlib import Path as _Path

from furo.navigation import get_navigation_tree
from sphinx.ext.autodoc.typehints import record_typehints
from sphinx.util.inspect import signature as _signature
from sphinx.util.inspect import stringify_signature

_sys.path.insert(0, str(_Path(__file__).parent))  # tutorial_state

project = "warmprior"
author = "the warmprior developers"
copyright = "2026, the warmprior developers. MIT licence"
_package = _metadata("warmprior")
release = version = _package["Version"]
_urls = dict(each.split(", ") for each in _package.get_all("Project-URL") or ())

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.doctest",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "sphinx-mathjax-offline",  # formulas need no internet
]
templates_path = ["_templates"]
html_theme = "furo"
smartquotes = False  # options and messages are to be copied
html_title = "warmprior"
html_static_path = ["_static"]
html_theme_options = {
    "source_repository": _urls.get("Repository", ""),
    "source_branch": "main",
    "source_directory": "docs/",
}
html_favicon = "_static/favicon.svg"
html_css_files = ["pages.css"]
# Pictures come with the pages that show them, and not with the static files a second time.
exclude_patterns = ["_build", "_templates", "tutorials/*.rst", "**.png"]

# A page per class and function of docs/reference/*.rst, without what classes inherit: TorchRL documents
# its own methods.
autosummary_generate = True
python_use_unqualified_type_names = True
autodoc_member_order = "bysource"
# Types of all parameters and results, those that the text speaks of in a sentence among them.
autodoc_typehints = "description"
autodoc_typehints_description_target = "all"
autodoc_inherit_docstrings = False
# A dataclass field would otherwise be described twice: by its class and by itself.
napoleon_use_ivar = True
# Keyword arguments show their types as other parameters do.
napoleon_custom_sections = [("Keyword Args", "Args")]
toc_object_entries_show_parents = "hide"

# The docstrings' examples are run by pytest.
doctest_test_doctest_blocks = ""
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3

# joblib says this when it replaces a worker whose memory has grown.
_warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)

# The tutorials run when the pages are built, two at a time, each from the same state; an error ends the
# build. ``make docs ARGS='-D plot_gallery=0'`` leaves them as text.
sphinx_gallery_conf = {
    "examples_dirs": "tutorials",
    "gallery_dirs": "auto_tutorials",
    "within_subsection_order": "FileNameSortKey",
    "parallel": 2,
    "reset_modules": ("matplotlib", "tutorial_state.reset"),
    "abort_on_example_error": True,
    "min_reported_time": 1_000_000,
    "write_computation_times": False,
    "show_signature": False,
    "download_all_examples": False,
    "notebook_extensions": {".py"},
    "capture_repr": ("_repr_html_",),
}


def _few_downloads(app, docname, source):
    """Leave the links to a tutorial's script and notebook, which stand below it."""
    if docname.startswith("auto_tutorials/"):
        above = r"\.\. only:: html\n\n    \.\. note::\n        :class: sphx-glr-download-link-note.*?(?=^\S)"
        below = r"    \.\. container:: sphx-glr-download sphx-glr-download-zip.*"
        source[0] = re.sub(f"{above}|{below}", "", source[0], flags=re.M | re.S)


def _link_as_repository(app, docname, source):
    """Link to built tutorials where Markdown links to their scripts, and give the index its tree."""
    if app.env.doc2path(docname).suffix == ".md":
        built = re.sub(r"\]\(tutorials\)", "](auto_tutorials/index.rst)", source[0])
        source[0] = re.sub(r"\]\(tutorials/(\w+)\.py\)", r"](auto_tutorials/\1.rst)", built)
    if docname == "index":
        source[0] += (_Path(__file__).parent / "_templates" / "contents.md").read_text()


def _show_own_signature(app, what, name, obj, options, signature, return_annotation):
    """Show what a class takes, with types, where a base class or metaclass hides it behind ``*args``."""
    if what == "class" and (signature or "").startswith("(*args"):
        record_typehints(app, what, name, obj.__init__, options, signature, return_annotation)
        own = stringify_signature(
            _signature(obj.__init__, bound_method=True), show_annotation=False, show_return_annotation=False
        )
        signature = signature if own.startswith("(*args") else own
    return signature, return_annotation


@_cache
def _documented():
    """Public names by the full names under which the reference has them."""
    pages = (_Path(__file__).parent / "reference").glob("*.rst")
    found = (
        re.findall(r"^(?:   ~|\.\. py:data:: )(warmprior[\w.]+)$", page.read_text(), re.M) for page in pages
    )
    return {name.rsplit(".", 1)[1]: name for names in found for name in names}


def _link_names(app, docname, source):
    """Link the public classes, and functions with ``()``, that Markdown names in code style."""

    def link(found):
        first, *rest = found[1].removesuffix("()").split(".")
        if first not in _documented() or not (first[0].isupper() or found[1].endswith("()")):
            return found[0]
        return f"{{py:obj}}`{found[1]} <{'.'.join([_documented()[first], *rest])}>`"

    if app.env.doc2path(docname).suffix == ".md":
        parts = re.split(r"(^```.*?^```$)", source[0], flags=re.M | re.S)
        text = r"(?<![`\[}])`([A-Za-z][\w.]*(?:\(\))?)`(?!`)"
        parts[::2] = (re.sub(text, link, part) for part in parts[::2])
        source[0] = "".join(parts)


def _resolve_other_names(app, env, node, contnode):
    """Link what is named as another module has it, such as ``warmprior.modules.Prior``, or by itself."""
    parts = node["reftarget"].split(".")
    known = [i for i, part in enumerate(parts) if part in _documented()]
    if node.get("refdomain") != "py" or not known or (known[0] and parts[0] != "warmprior"):
        return None
    target = ".".join([_documented()[parts[known[0]]], *parts[known[0] + 1 :]])
    domain = env.get_domain("py")
    return domain.resolve_xref(env, node["refdoc"], app.builder, node["reftype"], target, node, contnode)


def _fold_navigation(app, pagename, templatename, context, doctree):
    """Unfold the branch of the page alone: with all of the reference on every page it would be most of it."""
    if "furo_navigation_tree" in context:
        tree = context["toctree"](collapse=True, titles_only=True, maxdepth=-1, includehidden=True)
        context["furo_navigation_tree"] = get_navigation_tree(tree)


def _link_back_to_documentation(app, pagename, templatename, context, doctree):
    """Lead ``[docs]`` of a module's source to an object's page as that page names it.

    viewcode takes the package of the first one for all objects of a module, but some are documented as
    ``warmprior.NAME`` and others as ``warmprior.PACKAGE.NAME``.
    """
    if pagename.startswith("_modules/"):
        other = r'(/api/)([\w.]*?)(\w+)\.html#(?:\w+\.)*?\3((?:\.\w+)*)"'
        context["body"] = re.sub(other, r'\1\2\3.html#\2\3\4"', context["body"])


def _keep_what_formulas_need(app, error):
    """MathJax comes with inputs, outputs and voices that these pages do not use, 20 MB of them."""
    folder = _Path(app.outdir) / "_static" / "mathjax"
    kept = {folder / "tex-chtml.js", folder / "output" / "chtml" / "fonts"}
    for path in sorted(folder.rglob("*"), reverse=True):
        if path.is_file() and not kept & {path, *path.parents}:
            path.unlink()
        elif path.is_dir() and not any(path.iterdir()):
            path.rmdir()


def setup(app):
    """Connect the handlers above."""
    app.connect("source-read", _few_downloads)
    app.connect("source-read", _link_as_repository)
    app.connect("source-read", _link_names)
    app.connect("autodoc-process-signature", _show_own_signature)
    app.connect("missing-reference", _resolve_other_names)
    app.connect("html-page-context", _fold_navigation, priority=900)
    app.connect("html-page-context", _link_back_to_documentation)
    app.connect("build-finished", _keep_what_formulas_need, priority=900)
