#!/usr/bin/env python3
"""Adapts the links of docs/ to the book, and checks those of the book.

book.py               is a preprocessor of mdbook. A link that leaves docs/ becomes its text and the path in the repository, since
                      the book has no such page.
book.py check FOLDER  checks that each link within a built book leads to a page, and to a heading of it.
"""

import json
import os
import posixpath
import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LINK = re.compile(r"\[([^\]\n]*(?:\n[^\]\n]+)?)\]\(([^)\s]+)\)")


def adapted(content: str, page: str) -> str:
    """Returns a page's text with links that hold in the book."""

    def replace(link: re.Match[str]) -> str:
        text, target = link.groups()
        path, _, _ = target.partition("#")
        if "://" in path or not path:
            return link[0]
        path = posixpath.normpath(posixpath.join("docs", posixpath.dirname(page), path))
        if path.startswith("docs/"):
            # mdbook calls the page of a folder index.
            return link[0].replace("README.md", "index.md")
        return f"`{path}`" if path.endswith(text.strip("`")) else f"{text} (`{path}`)"

    parts = re.split(r"(^```.*?^```\s*$)", content, flags=re.MULTILINE | re.DOTALL)
    return "".join(part if part.startswith("```") else LINK.sub(replace, part) for part in parts)


def preprocess(items: list) -> None:
    """Adapts the links of chapters and of those below them."""
    for item in items:
        if isinstance(item, dict) and "Chapter" in item:
            chapter = item["Chapter"]
            chapter["content"] = adapted(chapter["content"], chapter.get("source_path") or "")
            preprocess(chapter["sub_items"])


class Page(HTMLParser):
    """The links and the anchors of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        for name, value in attributes:
            if name == "id" and value:
                self.anchors.add(value)
            elif name == "href" and tag == "a" and value:
                self.links.append(value)


def check(folder: Path) -> int:
    """Returns 1 if a link of a built book leads nowhere, else 0."""
    # The page of all pages repeats the links of each from another place.
    pages = {path: Page(path) for path in folder.rglob("*.html") if path.name not in ("print.html", "404.html", "toc.html")}
    faults, checked = set(), 0
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            checked += 1
            target = Path(os.path.normpath(path.parent / unquote(parts.path))) if parts.path else path
            anchor = unquote(parts.fragment)
            if not target.is_file() or (anchor and target in pages and anchor not in pages[target].anchors):
                faults.add(f"{path.relative_to(folder)}: {link}")
    for fault in sorted(faults):
        print(f"error: this link leads nowhere: {fault}", file=sys.stderr)
    print(f"{checked} links of {len(pages)} pages checked")
    return 1 if faults or checked < 1000 else 0


def main() -> int:
    match sys.argv[1:]:
        case ["supports", renderer]:
            return 0 if renderer == "html" else 1
        case ["check", folder]:
            return check(Path(folder))
        case []:
            _, book = json.load(sys.stdin)
            preprocess(book.get("items") or book.get("sections"))
            json.dump(book, sys.stdout)
            return 0
    print(__doc__, file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
