"""Sphinx: ``scripts/docs.sh`` builds the site from these pages, the docstrings and the scripts of ``gallery``."""

import re
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.ext.napoleon.docstring import GoogleDocstring

import curvireg_torch

ROOT = Path(__file__).parents[1]

project = "curvireg_torch"
copyright = "2026, the curvireg_torch authors; Apache-2.0"
version = release = curvireg_torch.__version__
extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "myst_parser",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["_build", "gallery"]
nitpicky = True

html_theme = "furo"
html_title = "curvireg_torch"
html_copy_source = False

myst_heading_anchors = 4  # named as GitHub names them

autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False  # torch says the same of every forward()
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True, "imported-members": True}
napoleon_custom_sections = ["Shape"]
# A colon in the first line of an attribute's docstring is a colon, and does not follow a type.
GoogleDocstring._consume_inline_attribute = lambda self: ("", self._dedent(self._consume_to_end()))  # type: ignore[method-assign]

sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "auto_gallery",
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "min_reported_time": 1,
}

PAGES = {
    "CHANGELOG.md": "project/changelog.md",
    "CONTRIBUTING.md": "project/contributing.md",
    "SECURITY.md": "project/security.md",
    "datasets/pascal3d/README.md": "project/pascal3d.md",
    "datasets/objectnet3d/README.md": "project/objectnet3d.md",
    "datasets/bop/README.md": "project/bop.md",
    "datasets/web/README.md": "project/web.md",
}
"""Pages of the site that are files elsewhere in the repository."""


def links_of_the_site(text: str, file: Path) -> str:
    """The text of ``file`` with its links to files, by which it can be read as a file, led to the site's pages."""

    def led(match: re.Match[str]) -> str:
        place = (file.parent / match[1]).resolve().relative_to(ROOT).as_posix()
        place = re.sub(r"^docs/gallery/(\w+)\.py$", r"docs/auto_gallery/\1.rst", place)
        place = "docs/index.md" if place == "README.md" else f"docs/{PAGES.get(place, '')}" if place in PAGES else place
        return f"](/{place.removeprefix('docs/')}" if place.startswith("docs/") else match[0]

    return re.sub(r"\]\(([\w./+-]+\.(?:md|py))(?=[#)])", led, text)


def copy_pages(app: Any, *_: Any) -> None:
    for place, page in PAGES.items():
        text = links_of_the_site((ROOT / place).read_text(encoding="utf-8"), ROOT / place)
        copy = Path(app.srcdir) / page
        if not copy.is_file() or copy.read_text(encoding="utf-8") != text:
            copy.parent.mkdir(exist_ok=True)
            copy.write_text(text, encoding="utf-8")


def lead_links(app: Any, page: str, source: list[str]) -> None:
    file = Path(app.env.doc2path(page))
    if file.suffix == ".md" and file.parent.name != "project":
        source[0] = links_of_the_site(source[0], file)


def short_names(app: Any, env: Any, node: Any, text: Any) -> Any:
    """A name in a docstring is that of the one documented object that ends so; of other libraries it is no link."""
    target = node.get("reftarget", "").strip(".")
    if node.get("refdomain") != "py":
        return None
    objects = env.get_domain("py").objects
    found = [target] if target in objects else sorted(n for n in objects if n.endswith("." + target.rsplit(".", 1)[-1]))
    if found:
        place = app.builder.get_relative_uri(node["refdoc"], objects[found[0]].docname)
        return nodes.reference("", "", text, internal=True, refuri=f"{place}#{objects[found[0]].node_id}")
    ours = target.startswith("curvireg_torch") or ("." not in target and target.isidentifier() and target not in SHAPES)
    return None if ours else text


SHAPES = {"B", "C", "D", "F", "H", "K", "Module", "N", "S", "T", "V", "W", "size"}
"""What napoleon takes for the names of types in our docstrings, and torch's Module, which it calls by this name."""


def setup(app: Any) -> None:
    app.connect("config-inited", copy_pages)
    app.connect("source-read", lead_links)
    app.connect("missing-reference", short_names)
