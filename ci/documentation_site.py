"""Hook of MkDocs: the site is made of ``docs/`` and of the pages elsewhere that it links to.

README becomes the first page. Links are written for readers of the repository; here each is turned
into one between pages of the site. A link to a file that is no page (the licence, code) becomes the
path of that file. Tables that the code gives are written where a page has their mark.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from ci.generated_tables import with_tables

ROOT = Path(__file__).parents[1]

#: A link or an image: its text, the path and the anchor; addresses and bare anchors are no match.
_LINK = re.compile(r"(!?)\[([^\]]*)\]\((?![a-z]+:|#)([^)#\s]+)(#[^)\s]*)?\)")

#: Page of the site for each page outside ``docs/``, by its path in the repository.
_pages: dict[str, str] = {}


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add README and every page outside ``docs/`` that a page links to."""
    _pages.clear()
    waiting = ["README.md", *(f"docs/{file.src_uri}" for file in files.documentation_pages())]
    while waiting:
        path = waiting.pop()
        text = (ROOT / path).read_text("utf-8")
        if not path.startswith("docs/"):
            name = "index.md" if path == "README.md" else path.lower().replace("/", "-")
            if name in files.src_uris:  # such as SECURITY.md beside docs/security.md
                name = f"about-{name}"
            _pages[path] = name
            files.append(File.generated(config, name, content=_rewritten(text, path)))
        for match in _LINK.finditer(text):
            target = _resolve(path, match[3])
            known = target in _pages or target in waiting or target.startswith("docs/")
            if target.endswith(".md") and not known and (ROOT / target).is_file():
                waiting.append(target)
    for path, name in _pages.items():  # again: now every page is known
        text = _rewritten((ROOT / path).read_text("utf-8"), path)
        files.remove(files.src_uris[name])
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Rewrite the links of a page of ``docs/``, and write its tables."""
    path = f"docs/{page.file.src_uri}"
    markdown = with_tables(markdown)
    return _rewritten(markdown, path) if (ROOT / path).is_file() else markdown


def _resolve(page: str, link: str) -> str:
    return posixpath.normpath(posixpath.join(posixpath.dirname(page), link))


def _rewritten(text: str, path: str) -> str:
    """Text of the page at a path of the repository, with links as the site needs them."""

    def rewrite(match: re.Match[str]) -> str:
        image, label, link, anchor = match[1], match[2], match[3], match[4] or ""
        target = _resolve(path, link)
        if target in _pages:
            return f"{image}[{label}]({_pages[target]}{anchor})"
        if target.startswith("docs/"):
            return f"{image}[{label}]({target.removeprefix('docs/')}{anchor})"
        return f"{label} (`{target}`)" if label.strip("`") != target else f"`{target}`"

    # Code stays as it is: a link in it is an example.
    parts = re.split(r"(^```.*?^```)", text, flags=re.M | re.S)
    return "".join(part if part.startswith("```") else _LINK.sub(rewrite, part) for part in parts)
