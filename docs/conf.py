"""Sphinx configuration: ``scripts/docs.sh`` builds the site from the pages, the docstrings and
``gallery``."""

import os
import re
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.ext.napoleon.docstring import GoogleDocstring

import curvireg_torch

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]  # the gallery imports scripts

import messages  # noqa: E402

project = "curvireg_torch"
copyright = "2026, the curvireg_torch authors; Apache-2.0"
version = release = curvireg_torch.__version__
extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "myst_parser",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
    "mathml",
]
exclude_patterns = ["_build", "gallery", "notebooks"]
nitpicky = True
nitpick_ignore = [  # types of annotations without a page
    ("py:class", "Image"),
    ("py:class", "curvireg_torch.data._base.Transforms"),
    ("py:class", "curvireg_torch.matching.cells.Packing"),
    ("py:class", "curvireg_torch.mesh.round_axis.RoundAxis"),
    ("py:class", "curvireg_torch.fitting.exactness.Exactness"),
    ("py:class", "curvireg_torch.geometry.framing.CropFrame"),
    ("py:class", "curvireg_torch.registration.target.TellingSymmetries"),
    ("py:class", "curvireg_torch.registration.result.Axis"),
    ("py:class", "curvireg_torch.rendering.contours._Level"),
    ("py:class", "curvireg_torch.utils.executors.Workers"),
]
html_math_renderer = "mathml"  # nothing is fetched from elsewhere

html_theme = "furo"
html_title = "curvireg_torch"
html_copy_source = False
smartquotes = False  # --azimuth stays as it is typed

myst_heading_anchors = 4  # the same anchors as on GitHub

copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False  # torch repeats one docstring for every forward()
autodoc_typehints_format = "short"
autodoc_default_options = {"members": True, "imported-members": True}
napoleon_custom_sections = ["Shape"]
# In the docstring of an attribute, text before a colon is not its type.
GoogleDocstring._consume_inline_attribute = lambda self: ("", self._dedent(self._consume_to_end()))  # type: ignore[method-assign]

sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "auto_gallery",
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "min_reported_time": 1,
    "write_computation_times": False,  # its page fetches scripts
}

COPIED_PAGES = {
    "CHANGELOG.md": "project/changelog.md",
    "CONTRIBUTING.md": "project/contributing.md",
    "SECURITY.md": "project/security.md",
    "datasets/pascal3d/README.md": "project/pascal3d.md",
    "datasets/objectnet3d/README.md": "project/objectnet3d.md",
    "datasets/bop/README.md": "project/bop.md",
    "datasets/web/README.md": "project/web.md",
}
"""Files outside ``docs`` and the pages of the site that show them."""

SHAPES = {"B", "C", "D", "F", "H", "K", "Module", "N", "Precision", "S", "T", "V", "W", "size"}
"""Words in docstrings that napoleon mistakes for types, type variables, torch's Module, and private
types."""


def site_links(text: str, file: Path, page: str) -> str:
    """Rewrite the links of ``file`` between files of the repository as links between pages of the
    site, relative to ``page``."""

    def site_link(match: re.Match[str]) -> str:
        path = (file.parent / match[1]).resolve().relative_to(ROOT).as_posix()
        path = re.sub(r"^docs/gallery/([\w/]+)\.py$", r"docs/auto_gallery/\1.rst", path)
        if path == "README.md":
            path = "docs/index.md"
        elif path in COPIED_PAGES:
            path = f"docs/{COPIED_PAGES[path]}"
        if not path.startswith("docs/"):
            return match[0]
        return f"]({os.path.relpath(path.removeprefix('docs/'), Path(page).parent)}"

    return re.sub(r"\]\(([\w./+-]+\.(?:md|py))(?=[#)])", site_link, text)


def write_pages(app: Any, *_: Any) -> None:
    """Write the pages of ``docs/project``."""
    pages = {
        page: site_links((ROOT / path).read_text("utf-8"), ROOT / path, page)
        for path, page in COPIED_PAGES.items()
    }
    for page, text in {
        **pages,
        "project/messages.md": messages.page(ROOT / "curvireg_torch"),
    }.items():
        copy = Path(app.srcdir) / page
        if not copy.is_file() or copy.read_text(encoding="utf-8") != text:
            copy.parent.mkdir(exist_ok=True)
            copy.write_text(text, encoding="utf-8")


def rewrite_links(app: Any, page: str, source: list[str]) -> None:
    file = Path(app.env.doc2path(page))
    if file.suffix == ".md" and file.parent.name != "project":
        source[0] = site_links(source[0], file, page)


def resolve_short_names(app: Any, env: Any, node: Any, text: Any) -> Any:
    """Link a name in a docstring to the one documented object that ends with it; names of other
    libraries stay text."""
    target = node.get("reftarget", "").strip(".")
    if node.get("refdomain") != "py":
        return None
    objects = env.get_domain("py").objects
    found = (
        [target]
        if target in objects
        else sorted(n for n in objects if n.endswith("." + target.rsplit(".", 1)[-1]))
    )
    if found:
        page = app.builder.get_relative_uri(node["refdoc"], objects[found[0]].docname)
        return nodes.reference(
            "", "", text, internal=True, refuri=f"{page}#{objects[found[0]].node_id}"
        )
    ours = target.startswith("curvireg_torch") or target.isidentifier()
    return None if ours and target.rsplit(".", 1)[-1] not in SHAPES else text


def setup(app: Any) -> None:
    app.connect("config-inited", write_pages)
    app.connect("source-read", rewrite_links)
    app.connect("missing-reference", resolve_short_names)
