"""The documentation site: `make docs` builds these pages, notebooks and the Python API into build/docs.

The source folder is the repository, so that links between files are the same on the site and in it.
"""

import ast
import inspect
import os
import re
import textwrap

import flx

project, author, release = "flx", "The flx authors", flx.__version__
project_copyright = "The flx authors; Apache-2.0"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "docs/index"
include_patterns = ["*.md", "docs/*", "notebooks/*.ipynb", "flx/weights/README.md"]
exclude_patterns = [".*", "build", "runs", "vendor"]

html_theme, html_title = "furo", "flx"
html_extra_path = ["front"]  # leads from the first page of the folder to docs/index.html
html_copy_source = False

myst_heading_anchors = 3  # links to headings, as in `formats.md#strokes`
suppress_warnings = ["myst.header", "misc.highlighting_failure"]  # pages may begin with any heading
# Notebooks are stored without results. FLX_DOCS_EXECUTE=cache runs them: about five minutes on slow cores.
nb_execution_mode = os.environ.get("FLX_DOCS_EXECUTE", "off")
nb_execution_timeout = 900
nb_execution_raise_on_error = True
nb_merge_streams = True  # a progress bar is one block

highlight_language = "text"  # of blocks that name none: commands
default_role = "code"  # docstrings write names in single backticks
autodoc_member_order = "bysource"
napoleon_use_rtype = napoleon_use_param = False
nitpicky = True
nitpick_ignore_regex = [("py:.*", ".*")]  # types in signatures are not all described here


def as_restructured_text(app, what, name, obj, options, lines):
    """Docstrings as Sphinx reads them: examples are code, bars and stars themselves, fields are listed."""
    found, code = [], False
    for line in lines:
        indented = line.startswith("    ")
        if line.strip() == "Example:":
            found, code = [*found, "Example::", ""], True
            continue
        code = code and (indented or not line.strip())
        found.append(line if code else re.sub(r"(?<!`)([|*])(?!`)", r"\\\1", line))
    lines[:] = found + (fields_of(obj) if what == "class" else [])


def fields_of(kind):
    """The fields of a class as its source has them, with their types, defaults and comments."""
    source = textwrap.dedent(inspect.getsource(kind))
    fields = [node for node in ast.parse(source).body[0].body if isinstance(node, ast.AnnAssign)]
    if not fields:
        return []
    listed = source.splitlines()[fields[0].lineno - 1 : fields[-1].end_lineno]
    return ["", "::", "", *listed, ""]


def short_signature(app, what, name, obj, options, signature, returned):
    """Arrays of any kind by their name, and no list of the fields, which stand below."""
    if what == "class":
        return "", None
    arrays = re.compile(r"_Buffer \|.*?complex \| bytes \| str\]")
    short = [
        text and arrays.sub("ArrayLike", text.replace("jaxlib._jax.", "")) for text in (signature, returned)
    ]
    return tuple(short)


def setup(app):
    """Before napoleon, which reads what this leaves."""
    app.connect("autodoc-process-docstring", as_restructured_text, priority=100)
    app.connect("autodoc-process-signature", short_signature)
