"""Check the links and pictures of a built site: targets and anchors exist, and pictures have a
description.

    python docs/check_site.py docs/_build/html

Nothing is fetched. Links to other hosts are not checked.
"""

import argparse
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class Page(HTMLParser):
    """Anchors, links and undescribed pictures of one page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.undescribed: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        found = dict(attributes)
        self.anchors |= {value for name in ("id", "name") if (value := found.get(name))}
        links = [value for name in ("href", "src") if (value := found.get(name))]
        # one package for each file, even if two document parts of it
        if found.get("class") == "viewcode-back":
            links = [link.partition("#")[0] for link in links]
        self.links += links
        if (
            tag == "img"
            and not (found.get("alt") or "").strip()
            and "_thumb." not in (found.get("src") or "")
        ):
            self.undescribed.append(found.get("src") or "?")


def find_faults(root: Path) -> Iterator[str]:
    """One line for each broken link and each picture without alternative text."""
    pages = {path: Page(path) for path in sorted(root.resolve().rglob("*.html"))}
    if not pages:
        yield f"{root}: no pages"
    for path, page in pages.items():
        for picture in page.undescribed:
            yield f"{path}: {picture} has no alternative text"
        for link in page.links:
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


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("root", type=Path)
    faults = list(find_faults(parser.parse_args().root))
    print("\n".join(faults) or "all links are valid")
    return int(bool(faults))


if __name__ == "__main__":
    raise SystemExit(main())
