"""The site: `make docs` builds it into docs/_build/html, without a network, with warnings as
errors.
"""

import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))
os.environ.setdefault("MUJOCO_GL", "egl")

from docutils import nodes  # noqa: E402
from docutils.utils.math.latex2mathml import tex2mathml  # noqa: E402
from pydantic import BaseModel  # noqa: E402

from elastic_env import __version__  # noqa: E402

project = "elastic-env"
author = "The elastic-env contributors"
release = __version__
copyright = "the elastic-env contributors, Apache-2.0"  # noqa: A001  Sphinx's name

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
default_role = "code"  # single backticks are code, in docstrings as in Markdown
exclude_patterns = ["_build", "generated/tutorials/*.ipynb", "generated/tutorials/*.py"]
suppress_warnings = ["config.cache", "myst.xref_missing.repository"]

html_theme = "furo"
html_title = "elastic-env"
html_show_sphinx = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
# formulas are MathML in the page, which every browser draws without a network
html_math_renderer = "mathml"

autodoc_member_order = "bysource"
autodoc_typehints = "none"
napoleon_use_ivar = True

sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "generated/tutorials",
    "filename_pattern": r"/\d_",
    "within_subsection_order": "FileNameSortKey",
    "download_all_examples": False,
    "show_memory": False,
    "remove_config_comments": True,
    "write_computation_times": False,
    "abort_on_example_error": True,
}


def _tables_as_text(app, what, name, obj, options, lines):  # noqa: ARG001  Sphinx's arguments
    """Show the Markdown tables of a docstring as they are: reStructuredText has no such tables."""
    shown = []
    inside = False
    for line in lines:
        is_row = line.lstrip().startswith("| ") or line.lstrip().startswith("|---")
        if is_row and not inside:
            shown += ["::", ""]
        elif inside and not is_row:
            shown.append("")
        shown.append(f"    {line}" if is_row else line)
        inside = is_row
    lines[:] = shown


def _fields(app, what, name, obj, options, lines) -> None:  # noqa: ARG001  Sphinx's arguments
    """List the fields of a configuration with unit and default, which stand in no docstring."""
    if isinstance(obj, type) and issubclass(obj, BaseModel):
        for field, info in obj.model_fields.items():
            default = (
                "required"
                if info.is_required()
                else f"default {info.get_default(call_default_factory=True)}"
            )
            lines += ["", f"* `{field}`: {info.description or 'see the class'}; {default}"]


def _formula(is_block: bool):
    def visit(translator, node) -> None:
        if is_block and node.get("number"):
            raise NotImplementedError("formulas with numbers are not drawn")
        tex = node.astext()
        for part in tex.split("\n\n") if is_block else [tex]:
            translator.body.append(tex2mathml(part, as_block=is_block))
        raise nodes.SkipNode

    return visit


def setup(app) -> None:
    """Connect what is particular to this site."""
    app.add_html_math_renderer("mathml", (_formula(False), None), (_formula(True), None))
    app.connect("autodoc-process-docstring", _fields)
    app.connect("autodoc-process-docstring", _tables_as_text)
