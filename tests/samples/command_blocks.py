"""The fenced blocks of the README and of docs/, their comments, and the commands in them."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = {
    str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/**/*.md")))
}
TRIED = ("sh", "python")  # languages of the blocks that a reader may want to copy
OTHERS = {"text", "json", "yaml"}
NOT_RUN, PARSED, NEEDS = "not run", "parsed only", "needs"


@dataclass(frozen=True)
class Block:
    """A fenced block of a page, and the text of the comment before it."""

    page: str
    line: int
    language: str
    text: str
    mark: str | None
    reason: str | None


FENCE = re.compile(
    r"(?:^<!-- (?P<mark>[a-z ]+): (?P<reason>[^\n]+) -->\n)?"
    r"^```(?P<language>[^\n]*)\n(?P<text>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)


def blocks(page: str) -> list[Block]:
    """The page's blocks in order."""
    text = PAGES[page]
    return [
        Block(
            page,
            text.count("\n", 0, m.start("text")),
            m["language"],
            m["text"],
            m["mark"],
            m["reason"],
        )
        for m in FENCE.finditer(text)
    ]


def tried(page: str) -> list[Block]:
    return [block for block in blocks(page) if block.language in TRIED]


@dataclass
class Command:
    """One command of a shell line, and the file that its output goes to."""

    words: list[str]
    output: str | None = None


def commands(block: Block) -> Iterator[Command]:
    """The commands of a block's lines, without comments."""
    for line in re.sub(r"\\\n\s*", " ", block.text).splitlines():
        tokens = shlex.shlex(line, posix=True, punctuation_chars=True)
        tokens.whitespace_split = True
        found = Command([])
        for token in tokens:
            if token in ("&&", ";"):
                yield found
                found = Command([])
            elif token == ">":
                found.output = next(iter(tokens))
            else:
                found.words.append(token)
        if found.words:
            yield found
