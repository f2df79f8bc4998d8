"""A report as a test reads it."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

VOID = {"meta", "br", "hr", "img", "input", "link"}
LOADS = {"href", "src", "xlink:href", "srcset", "data", "action", "poster", "background"}
FORBIDDEN = {"script", "link", "iframe", "object", "embed", "base", "form", "foreignobject"}


class Page(HTMLParser):
    """Well-formed and self-contained, or `faults` says where it is not."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.html = html
        self.faults: list[str] = []
        self.open: list[str] = []
        self.ids: list[str] = []
        self.starts: dict[str, int] = {}
        self.words: list[str] = []
        self.pictures = 0
        self.feed(html)
        self.close()
        self.faults += [f"<{tag}> is not closed" for tag in self.open]
        for never in ("url(", "@import", "javascript:"):
            if never in html.partition("</style>")[0]:
                self.faults.append(f"{never} in the style")

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def section(self, name: str) -> str:
        """The text from one id to the next."""
        first = self.starts[name]
        after = min([n for n in self.starts.values() if n > first] or [len(self.words)])
        return " ".join(" ".join(self.words[first:after]).split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._look_at(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._look_at(tag, attrs)

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.faults.append(f"</{tag}> at {self.getpos()} closes something else")

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] != "style":
            self.words.append(data)

    def _look_at(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag in FORBIDDEN:
            self.faults.append(f"<{tag}> at {self.getpos()}")
        names = [name for name, _ in attrs]
        if len(set(names)) < len(names):
            self.faults.append(f"<{tag}> has an attribute twice: {names}")
        for name, value in attrs:
            if name.startswith("on"):
                self.faults.append(f"{name}= at {self.getpos()}")
            if name in LOADS and not (value or "").startswith(("#", "data:image/jpeg;base64,")):
                self.faults.append(f"{name}={value!r} leads out of the file")
            if name == "id":
                self.ids.append(value or "")
                self.starts[value or ""] = len(self.words)
            if (value or "").startswith("data:"):
                self.pictures += 1
            if (value or "").lower() in ("nan", "inf", "-inf"):
                self.faults.append(f"{name}={value} at {self.getpos()}")


def read_page(path: Path) -> Page:
    return Page(path.read_text(encoding="utf-8"))
