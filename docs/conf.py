"""How Sphinx builds the site: ``make docs``. What follows from registries and docstrings is in ``catalogue.py``."""

from __future__ import annotations

import importlib
import inspect
import sys
from functools import reduce
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import catalogue  # noqa: E402  beside this file

import rise_agents  # noqa: E402

project = "RISE suite"
version = release = rise_agents.__version__
copyright = ""

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["examples"]
highlight_language = "text"  # of blocks that name none

myst_heading_anchors = 4  # as forges name them

nitpicky = True
autodoc_member_order = "bysource"
autodoc_default_options = {"no-value": True}
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
napoleon_use_ivar = True  # an attribute that a class docstring lists is not described twice

html_theme = "furo"
html_title = project
html_copy_source = html_show_copyright = html_show_sphinx = False
html_static_path = ["static"]
html_css_files = ["site.css"]


class Links(SphinxTransform):
    """Links to files of the repository lead to what the site has of them."""

    default_priority = 400  # before downloads are collected

    def apply(self, **_: Any) -> None:
        """A module becomes its page of the API, a name in it its place there; a page beside ``docs`` its copy."""
        for node in list(self.document.findall(addnodes.download_reference)):
            path = (Path(self.env.doc2path(node["refdoc"])).parent / node["reftarget"]).resolve()
            if module := catalogue.module_of(path):
                name = node.astext() if isinstance(node.next_node(nodes.literal), nodes.literal) else ""
                inside = module if name in ("", path.name) else f"{module}.{name}"
                kind = "mod" if inside == module else "obj"
                target = {"refdomain": "py", "reftype": kind, "reftarget": inside, "refdoc": node["refdoc"]}
                node.replace_self(addnodes.pending_xref("", *node.children, refexplicit=True, **target))
            elif path.suffix == ".py":
                self._lead(node, f"{catalogue.FOLDER}/examples/{path.stem}", None)
        for node in list(self.document.findall(addnodes.pending_xref)):
            name = Path(node["reftarget"].partition("#")[0]).name
            beside = name if name.endswith(".md") else f"{name}.md"
            if node["reftype"] == "myst" and beside in catalogue.BESIDE:
                self._lead(node, catalogue.BESIDE[beside], node.get("reftargetid"))

    def _lead(self, node: nodes.Element, page: str, anchor: str | None) -> None:
        about = {"refdomain": "doc", "reftype": "myst", "reftarget": page, "reftargetid": anchor}
        to = addnodes.pending_xref("", *node.children, refexplicit=True, refdoc=node["refdoc"], **about)
        node.replace_self(to)


def found(name: str) -> bool:
    """Whether there is such a module, or such a name in one."""
    parts = name.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            module = importlib.import_module(".".join(parts[:cut]))
        except (ImportError, ValueError):
            continue
        try:
            return reduce(getattr, parts[cut:], module) is not None
        except AttributeError:
            continue
    return False


def name_without_page(app: Sphinx, env: Any, node: nodes.Element, content: nodes.Element) -> Any:
    """What exists but has no page of its own here is shown without a link; what does not exist stays an error."""
    if node.get("refdomain") != "py":
        return None
    target, module, inside = node["reftarget"].lstrip("."), node.get("py:module"), node.get("py:class")
    package = module.rpartition(".")[0] if module else ""
    places = [module and inside and f"{module}.{inside}", module, package, "builtins", "typing"]
    if any(found(".".join((place, target))) for place in places if place) or found(target):
        return content
    typing_only = module and f"import {target}\n" in inspect.getsource(importlib.import_module(module))
    return content if typing_only else None


def without_markdown(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Docstrings of environments are Markdown, in the sections that Gymnasium has: the API refers to their pages."""
    if any(line.startswith("## ") for line in lines):
        pages = [env for env, entry in catalogue.entries() if entry.replace(":", ".") == name]
        said = lines[: lines.index("")]
        more = [f"All about it: :doc:`/{catalogue.FOLDER}/environments/{page}`." for page in pages]
        lines[:] = [*said, "", *more]


def without_fields(app: Sphinx, what: str, name: str, thing: Any, skip: bool, options: Any) -> bool | None:
    """Fields of named tuples are told by their class."""
    return True if str(getattr(thing, "__doc__", "")).startswith("Alias for field number") else None


def only_what_is_there(app: Sphinx, docname: str, source: list[str]) -> None:
    """Results are on the site once they are published."""
    if docname == "index" and not (HERE / "results" / "README.md").exists():
        source[0] = source[0].replace("\nresults/README\n", "\n")


def setup(app: Sphinx) -> None:
    """Connect what is above; called by Sphinx."""
    app.connect("builder-inited", lambda app: catalogue.write(HERE / catalogue.FOLDER))
    app.connect("source-read", only_what_is_there)
    app.connect("autodoc-process-docstring", without_markdown)
    app.connect("autodoc-skip-member", without_fields)
    app.connect("missing-reference", name_without_page)
    app.add_transform(Links)
