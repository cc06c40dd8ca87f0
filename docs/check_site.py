"""Check a built site: targets of links exist, pictures have a description, the search finds what
people look for, and no page needs the network.

    python docs/check_site.py docs/_build/html

Nothing is fetched. Links to other hosts are not checked.
"""

import argparse
import json
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

SEARCHED = {
    "STEP": "guides/unit-and-up",
    "HEIC": "guides/photographs",
    "USDZ": "guides/unit-and-up",
    "URDF": "guides/unit-and-up",
    "Unity": "guides/blender-unity",
    "Blender": "guides/blender-unity",
    "ONNX": "guides/layers",
    "unknown focal length": "guides/cameras",
}
"""What people search for, and the page that they want."""

LOADED = {"script": "src", "img": "src", "iframe": "src", "link": "href"}
"""Attributes by tag of what a browser loads unasked."""


class Page(HTMLParser):
    """Anchors, links and undescribed pictures of one page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.undescribed: list[str] = []
        self.fetched: list[str] = []
        self.dashed: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        found = dict(attributes)
        self.anchors |= {value for name in ("id", "name") if (value := found.get(name))}
        links = [value for name in ("href", "src") if (value := found.get(name))]
        # one package for each file, even if two document parts of it
        if found.get("class") == "viewcode-back":
            links = [link.partition("#")[0] for link in links]
        self.links += links
        loaded = found.get(LOADED.get(tag, "")) or ""
        is_shown = found.get("rel") not in ("canonical", "next", "prev", "search", "index")
        if urlsplit(loaded).netloc and is_shown:
            self.fetched.append(loaded)
        if (
            tag == "img"
            and not (found.get("alt") or "").strip()
            and "_thumb." not in (found.get("src") or "")
        ):
            self.undescribed.append(found.get("src") or "?")

    def handle_data(self, data: str) -> None:
        self.dashed += re.findall(r"\u2013[a-z][a-z-]+", data)


def find_faults(root: Path) -> Iterator[str]:
    """One line for each broken link and each picture without alternative text."""
    pages = {path: Page(path) for path in sorted(root.resolve().rglob("*.html"))}
    if not pages:
        yield f"{root}: no pages"
    for path, page in pages.items():
        for picture in page.undescribed:
            yield f"{path}: {picture} has no alternative text"
        for address in page.fetched:
            yield f"{path}: {address} is fetched from elsewhere"
        for option in page.dashed:
            yield f"{path}: {option} begins with a dash that cannot be typed"
        for link in page.links:
            if link.startswith("/"):
                yield f"{path}: {link} is absolute"
                continue
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            target = target / "index.html" if target.is_dir() else target
            if not target.is_file():
                yield f"{path}: {link} does not exist"
            elif (
                parts.fragment
                and target in pages
                and unquote(parts.fragment) not in pages[target].anchors
            ):
                yield f"{path}: {link} has no such anchor"


def search_faults(root: Path) -> Iterator[str]:
    """One line for each of the ``SEARCHED`` words that the site's search does not find on its
    page."""
    from sphinx.search.en import SearchEnglish

    language = SearchEnglish({})
    text = (root / "searchindex.js").read_text(encoding="utf-8")
    index = json.loads(text.removeprefix("Search.setIndex(").rstrip(";\n").removesuffix(")"))
    for words, page in SEARCHED.items():
        number = index["docnames"].index(page)
        for word in words.split():
            term = language.stem(word.lower())
            found = [index[name].get(term, []) for name in ("terms", "titleterms")]
            pages = [place for one in found for place in (one if isinstance(one, list) else [one])]
            if number not in pages:
                yield f"{root}: the search for {word!r} does not find {page}"


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("root", type=Path)
    root = parser.parse_args().root
    faults = [*find_faults(root), *search_faults(root)]
    print("\n".join(faults) or "all links are valid")
    return int(bool(faults))


if __name__ == "__main__":
    raise SystemExit(main())
