"""Links within a built site that lead nowhere: python -m tests.links FOLDER."""

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class _Page(HTMLParser):
    """What a page points at, and what in it can be pointed at."""

    def __init__(self, text: str):
        super().__init__()
        self.targets, self.anchors = set[str](), {""}
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value for name, value in attrs if value is not None}
        self.anchors |= {given[name] for name in ("id", "name") if name in given}
        self.targets |= {given[name] for name in ("href", "src") if name in given}


def broken_links(site: Path) -> list[str]:
    """Each "page: target" whose file is missing, or whose anchor is; links to other sites are not followed."""
    pages = {path: _Page(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}
    return [
        f"{path.relative_to(site)}: {target}"
        for path, page in pages.items()
        for target in sorted(page.targets)
        if not _leads_somewhere(path, target, pages)
    ]


def _leads_somewhere(path: Path, target: str, pages: dict[Path, _Page]) -> bool:
    link = urlsplit(target)
    if link.scheme or link.netloc:
        return True
    place = (path.parent / unquote(link.path)).resolve() if link.path else path
    if not place.is_file() or place not in pages:
        return place.is_file() and not link.fragment
    return unquote(link.fragment) in pages[place].anchors


if __name__ == "__main__":
    found = broken_links(Path(sys.argv[1]).resolve())
    print("\n".join(found) or "Every link within the site leads somewhere.")
    sys.exit(bool(found))
