"""Check the built site: links lead somewhere, no other host is asked, lists are lists.

python docs/check_site.py FOLDER

MkDocs checks the links of Markdown. This script checks the pages themselves, with what
the theme and the API reference add.
"""

from __future__ import annotations

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

# Elements that load something when a page opens, and the attribute that says what.
LOADED = {
    "script": "src",
    "img": "src",
    "iframe": "src",
    "source": "src",
    "link": "href",
}
# Relations of a `link` that load nothing.
NAMED = {"canonical", "next", "prev", "alternate"}


class Page(HTMLParser):
    """What a page links to, loads and can be linked to.

    Attributes:
        links: Addresses that a reader can follow.
        loaded: Addresses that the browser asks for by itself.
        places: Names of the places in the page.
        lost: Items of lists that have become text of a paragraph.
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: set[str] = set()
        self.loaded: set[str] = set()
        self.places: set[str] = set()
        self.lost: list[str] = []
        self._paragraph: list[str] | None = None
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Notes the addresses and the name of an element."""
        values = {name: value or "" for name, value in attrs}
        self.places |= {values[name] for name in ("id", "name") if name in values}
        if tag == "p":
            self._paragraph = []
        if tag == "a" and "href" in values:
            self.links.add(values["href"])
        if tag in LOADED and values.get("rel") not in NAMED:
            self.loaded.add(values.get(LOADED[tag], ""))

    def handle_data(self, data: str) -> None:
        """Notes the text of a paragraph."""
        if self._paragraph is not None:
            self._paragraph.append(data)

    def handle_endtag(self, tag: str) -> None:
        """Looks for items of lists in a paragraph."""
        if tag == "p" and self._paragraph is not None:
            text = "".join(self._paragraph)
            self.lost += re.findall(r"^ *[-*] +\S.{0,40}", text, flags=re.MULTILINE)
            self._paragraph = None


def faults(folder: Path) -> list[str]:
    """Returns what is wrong with a site.

    Args:
        folder: The site, as ``mkdocs build`` writes it.
    """
    pages = {
        path.resolve(): Page(path.read_text(encoding="utf-8"))
        for path in sorted(folder.rglob("*.html"))
    }
    found = [] if pages else [f"{folder} has no pages"]
    for path, page in pages.items():
        name = path.relative_to(folder.resolve())
        found += [f"{name}: no item of a list: {text}" for text in page.lost]
        for address in sorted(page.loaded):
            if urlsplit(address).netloc:
                found.append(f"{name}: loads {address}")
            elif not address.startswith("data:"):
                found += dead(folder, path, address, pages)
        for address in sorted(page.links):
            parts = urlsplit(address)
            if not (parts.scheme or parts.netloc):
                found += dead(folder, path, address, pages)
    for path in sorted(folder.rglob("*.css")):
        text = path.read_text(encoding="utf-8")
        for address in re.findall(r"url\(['\"]?((?:https?:)?//[^)]*)", text):
            found.append(f"{path.relative_to(folder)}: loads {address}")
    return found


def dead(folder: Path, path: Path, address: str, pages: dict[Path, Page]) -> list[str]:
    """Returns why a link inside the site leads nowhere; nothing if it is good."""
    parts = urlsplit(address)
    root = folder.resolve()
    target = path
    if parts.path:
        base = root if parts.path.startswith("/") else path.parent
        target = (base / unquote(parts.path).lstrip("/")).resolve()
    if target.is_dir():
        target /= "index.html"
    name = path.relative_to(root)
    # the page for what is not found does not know where it is
    if name.name == "404.html":
        return []
    if not target.is_file():
        return [f"{name}: {address} does not exist"]
    place = unquote(parts.fragment)
    if place and target in pages and place not in pages[target].places:
        return [f"{name}: {address} has no such place"]
    return []


def main() -> int:
    """Prints what is wrong."""
    found = faults(Path(sys.argv[1]))
    print("\n".join(found[:50]) or "every link and list is good")
    return bool(found)


if __name__ == "__main__":
    sys.exit(main())
