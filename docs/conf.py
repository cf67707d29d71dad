"""How Sphinx builds the site: ``make docs``. What follows from registries and docstrings is in ``catalogue.py``."""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from functools import cache, reduce
from pathlib import Path
from typing import Any

from docutils import nodes
from numpy.typing import ArrayLike
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform
from sphinx.util.nodes import make_refnode
from sphinx.util.typing import stringify_annotation

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import catalogue  # noqa: E402  beside this file

import rise_agents  # noqa: E402

project = "RISE suite"
version = release = rise_agents.__version__
copyright = ""

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["examples", "results/summary.md"]  # the latter: for forges; its content is in the page
highlight_language = "text"  # of blocks that name none

myst_heading_anchors = 4  # as forges name them

nitpicky = True
autodoc_member_order = "bysource"
autodoc_default_options = {"no-value": True}
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
default_role = "literal"
add_module_names = False
python_use_unqualified_type_names = True
napoleon_use_ivar = True  # an attribute that a class docstring lists is not described twice

html_theme = "furo"
html_title = project
html_static_path, html_css_files = [str(HERE / "site.css")], ["site.css"]
html_copy_source = html_show_copyright = html_show_sphinx = False


class Links(SphinxTransform):
    """Links to files of the repository lead to what the site has of them, names to where they are defined."""

    default_priority = 400  # before downloads are collected

    def apply(self, **_: Any) -> None:
        """A module becomes its page of the API, a name in it its place there; a page beside ``docs`` its copy."""
        for node in list(self.document.findall(addnodes.download_reference)):
            path = (Path(self.env.doc2path(node["refdoc"])).parent / node["reftarget"]).resolve()
            if module := catalogue.module_of(path):
                words = node.astext() if isinstance(node.next_node(nodes.literal), nodes.literal) else ""
                named = all(part.isidentifier() for part in words.split("."))
                lead(node, "py", "obj", f"{module}.{words}" if named else module)
            elif path.parent == HERE / "examples":
                lead(node, "doc", "myst", f"{catalogue.FOLDER}/examples/{path.stem}")
        for node in list(self.document.findall(addnodes.pending_xref)):
            name = Path(node["reftarget"].partition("#")[0]).name
            beside = name if name.endswith(".md") else f"{name}.md"
            if node["reftype"] == "myst" and beside in catalogue.BESIDE:
                lead(node, "doc", "myst", catalogue.BESIDE[beside], node.get("reftargetid"))
            elif node["refdomain"] == "py":
                node["reftarget"] = home(node) or node["reftarget"]


def lead(node: nodes.Element, domain: str, kind: str, target: str, anchor: str | None = None) -> None:
    """Put a reference in the place of another one, with its words."""
    where = {"refdoc": node["refdoc"], "refexplicit": True, "refwarn": True, "reftargetid": anchor}
    about = {"refdomain": domain, "reftype": kind, "reftarget": target}
    node.replace_self(addnodes.pending_xref("", *node.children, **about, **where))


def home(node: nodes.Element) -> str | None:
    """The full name of what a reference means, as Python finds it from where it stands; None: nothing.

    What a package hands on is at home where it is defined.
    """
    target, module = node["reftarget"].lstrip("."), node.get("py:module")
    module = module or ""
    places = (f"{module}.{node.get('py:class')}", module, module.rpartition(".")[0])
    for name in [
        *(f"{place}.{target}" for place in places if module and place),
        target,
        f"builtins.{target}",
    ]:
        thing = found(name)
        if thing is not None:
            origin = getattr(thing, "__module__", None), getattr(thing, "__qualname__", None)
            ours = name.partition(".")[0] in catalogue.PACKAGES and all(
                isinstance(part, str) for part in origin
            )
            return ".".join(map(str, origin)) if ours else name
    return None


@cache
def found(name: str) -> Any:
    """The module, or the thing in one, that has this full name; None: there is none."""
    parts = name.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            return reduce(getattr, parts[cut:], importlib.import_module(".".join(parts[:cut])))
        except (ImportError, AttributeError, ValueError):
            continue
    return None


def without_page(app: Sphinx, env: Any, node: nodes.Element, content: nodes.Element) -> Any:
    """What exists without a description here leads to what holds it; what does not exist stays an error."""
    if node["refdomain"] != "py":
        return None
    name, known = node["reftarget"], env.domains.python_domain
    if found(name) is None and not for_annotations(name.partition(".")[0], node.get("py:module")):
        return None
    while name and name not in known.objects:
        name = name.rpartition(".")[0]
    if not name:
        return content
    there = known.objects[name]
    return make_refnode(app.builder, node["refdoc"], there.docname, there.node_id, content, name)


def for_annotations(name: str, module: str | None) -> bool:
    """Whether a module imports ``name`` for annotations alone: nobody can find it there at run time."""
    text = inspect.getsource(importlib.import_module(module)) if module else ""
    return bool(re.search(rf"^    (from|import) .*\b{re.escape(name)}\b", text, re.MULTILINE))


def without_markdown(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Docstrings of environments are Markdown, in the sections that Gymnasium has: the API refers to their pages."""
    if any(line.startswith("## ") for line in lines):
        pages = [env for env, entry in catalogue.entries() if entry.replace(":", ".") == name]
        said = lines[: lines.index("")]
        more = [f"All about it: :doc:`/{catalogue.FOLDER}/environments/{page}`." for page in pages]
        lines[:] = [*said, "", *more]


def without_repetition(
    app: Sphinx, what: str, name: str, thing: Any, skip: bool, options: Any
) -> bool | None:
    """Fields of named tuples are told by their class, and a class that is an attribute where it is defined."""
    field = str(getattr(thing, "__doc__", "")).startswith("Alias for field number")
    return (
        True if field or (what == "class" and inspect.isclass(thing) and thing.__qualname__ == name) else None
    )


def with_short_arrays(app: Sphinx, what: str, name: str, thing: Any, options: Any, *texts: str | None) -> Any:
    """Signatures say ``NDArray`` and ``ArrayLike``, as the code does, not what NumPy makes of them."""
    array = r"~numpy\.ndarray\[tuple\[~typing\.Any, \.\.\.\], ~numpy\.dtype\[([^\[\]]*)\]\]"
    like, any_array = stringify_annotation(ArrayLike, "smart"), "~numpy.typing.NDArray"

    def short(text: str) -> str:
        text = re.sub(array, rf"{any_array}[\1]", text.replace(like, "~numpy.typing.ArrayLike"))
        return re.sub(r"NDArray\[[~\w.]*_ScalarT\]", "NDArray", text)

    return tuple(text and short(text) for text in texts)


def only_what_is_there(app: Sphinx, docname: str, source: list[str]) -> None:
    """Results are on the site once they are published."""
    if docname == "index" and not (HERE / "results" / "README.md").exists():
        lines = source[0].splitlines(keepends=True)
        source[0] = "".join(line for line in lines if "results/README" not in line)


def in_one_document(app: Sphinx, page: nodes.document) -> None:
    """Blocks of reStructuredText in Markdown keep a document of their own, and the whole environment with it.

    It would be stored with every page.
    """
    for node in page.findall():
        node.document = page


def setup(app: Sphinx) -> None:
    """Connect what is above; called by Sphinx."""
    app.connect("builder-inited", lambda app: catalogue.write(Path(app.srcdir) / catalogue.FOLDER))
    app.connect("source-read", only_what_is_there)
    app.connect("env-get-outdated", lambda *_: ["index"])  # which results come to, and go from
    app.connect("autodoc-process-docstring", without_markdown)
    app.connect("autodoc-process-signature", with_short_arrays)
    app.connect("autodoc-skip-member", without_repetition)
    app.connect("doctree-read", in_one_document)
    app.connect("missing-reference", without_page)
    app.add_transform(Links)
