"""Sphinx configuration. Build with ``make docs``."""

from __future__ import annotations

import importlib
import inspect
import re
import shutil
from importlib.metadata import version as installed_version
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

HERE = Path(__file__).parent

project = "sb3-knntd"
author = "The sb3-knntd developers"
project_copyright = author
release = version = installed_version("sb3-knntd")

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx_copybutton"]
exclude_patterns = ["_build"]
smartquotes = False
html_theme = "furo"
html_title = f"sb3-knntd {version}"

# Every reference must resolve; `make docs` turns warnings into errors. Names of other projects and of the kernels,
# which have no page, stay plain text.
nitpicky = True
nitpick_ignore_regex = [
    (r"py:.*", r"(?!sb3_knntd\b)\w+\..*"),
    (r"py:.*", r"sb3_knntd\.kernels\..*"),
    # Names imported only for type checking, type variables and type aliases.
    (r"py:.*", r"Axes|BaseCallback|Figure|Path|VecEnv|GymEnv|MaybeCallback|Schedule|State|Target"),
    (r"py:.*", r"(sb3_knntd\..*\.)?(Self\w+|Function)"),
    (r"py:.*", r"ActionColumns|Exploration|RandomStream|VectorEnv"),
    (r"py:.*", r"(sb3_knntd\..*\.)?(Checklist|PlanningModel|Rules|SpacedPolicy|VisitedBounds)"),
]

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "cache"
nb_execution_raise_on_error = True
nb_merge_streams = True

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_preserve_defaults = True
add_module_names = False
python_use_unqualified_type_names = True
maximum_signature_line_length = 88

# Publishers block automated requests.
linkcheck_ignore = [r"https://doi\.org/.*"]

copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True


def insert_docstrings(app: Sphinx, docname: str, source: list[str]) -> None:
    """Replace ``{docstring}`` blocks by the docstrings of environments, which are Markdown as in gymnasium."""

    def docstring(match: re.Match[str]) -> str:
        module, name = match[1].rsplit(".", 1)
        return inspect.getdoc(getattr(importlib.import_module(module), name)) or ""

    source[0] = re.sub(r"^```\{docstring\} (\S+)\n```$", docstring, source[0], flags=re.MULTILINE)


def escape_stars(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Escape the stars in shapes, (n_envs, *obs_shape), and in e *= γ λ, which are no emphasis."""
    lines[:] = [re.sub(r"(?<=[ (])\*(?=\w+\)|=)", r"\\*", line) for line in lines]


def copy_notebooks(app: Sphinx) -> None:
    """Copy the notebooks of ``examples/``, because Sphinx only reads files below its own folder."""
    for notebook in (HERE.parent / "examples").glob("*.ipynb"):
        shutil.copy2(notebook, HERE / "examples")


def setup(app: Sphinx) -> None:
    app.connect("builder-inited", copy_notebooks)
    app.connect("source-read", insert_docstrings)
    app.connect("autodoc-process-docstring", escape_stars)
