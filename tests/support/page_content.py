"""Helpers that read the text and the parts of a page."""

from __future__ import annotations

import re
from collections import Counter
from html.parser import HTMLParser

from balance_cli.report.blocks import Details, Section, Table


def read(html: str) -> Tags:
    tags = Tags()
    tags.feed(html)
    tags.close()
    return tags


def texts(section, kind: str) -> str:
    return " ".join(block.text for block in section.blocks if block.kind == kind)


def tables(made: Section) -> list[Table]:
    inner = [block for details in made.blocks if isinstance(details, Details) for block in details.blocks]
    return [block for block in (*made.blocks, *inner) if isinstance(block, Table)]


def row_of(made: Section, head: str, name: str) -> list[str]:
    """The cells of the row of this name in the table with this word in its head."""
    table = next(item for item in tables(made) if head in [cell.text for cell in item.head[0]])
    return [cell.text for cell in next(row for row in table.rows if row[0].text == name)]


class Tags(HTMLParser):
    """Checks that every tag is closed in order, and collects attributes and text."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: Counter[str] = Counter()
        self.references: set[str] = set()
        self.outside: list[str] = []
        self.text: list[str] = []
        self.in_script = False

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids[value] += 1
            if name in ("href", "xlink:href") and value.startswith("#"):
                self.references.add(value[1:])
            elif name in ("src", "href", "xlink:href", "data", "action") and not value.startswith("data:"):
                self.outside.append(value)
            self.references.update(re.findall(r"url\(#([^)]+)\)", value or ""))
        if tag in ("link", "iframe", "object"):
            self.outside.append(tag)
        self.in_script = tag == "script"

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        self.in_script = False
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not self.in_script:
            self.text.append(data)


VOID = {"meta", "br", "hr", "img", "link", "input"}
