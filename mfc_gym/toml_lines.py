"""Where the entries of a TOML document stand: `tomllib` gives their values without their lines."""

import re
from dataclasses import dataclass

Path = tuple[str | int, ...]
TOKEN = re.compile(
    r"""(?P<comment>\#[^\n]*)
      | (?P<text>\"\"\"(?:\\.|[^\\])*?\"{3,5} | '{3}.*?'{3,5} | "(?:\\.|[^"\\\n])*" | '[^'\n]*')
      | (?P<newline>\n)
      | (?P<mark>[\[\]{},=.])
      | (?P<bare>[^\s\[\]{},=.\#"']+)""",
    re.VERBOSE | re.DOTALL,
)


@dataclass(frozen=True)
class _Token:
    kind: str
    text: str
    line: int


def line_numbers(text: str) -> dict[Path, int]:
    """{path of keys and list indices: line, from 1} of every key, table and list entry of a valid TOML document."""
    return _Reader(text).document()


class _Reader:
    def __init__(self, text: str) -> None:
        self.tokens = []
        line = 1
        for match in TOKEN.finditer(text):
            if match.lastgroup != "comment":
                self.tokens.append(_Token(str(match.lastgroup), match.group(), line))
            line += match.group().count("\n")
        self.tokens.append(_Token("end", "", line))
        self.position = 0
        self.lines: dict[Path, int] = {}

    @property
    def token(self) -> _Token:
        return self.tokens[self.position]

    def accept(self, *texts: str) -> bool:
        """Whether the next token is one of these marks; if so, it is passed."""
        found = self.token.kind in ("mark", "newline") and self.token.text in texts
        self.position += found
        return found

    def document(self) -> dict[Path, int]:
        table: Path = ()
        while self.token.kind != "end":
            if self.accept("\n"):
                continue
            if self.accept("["):
                self.accept("[")
                table = self.key(())
                while self.accept("]"):
                    pass
            else:
                self.pair(table)
        return self.lines

    def key(self, path: Path) -> Path:
        """a.b."c" -> (a, b, c); every prefix that is new is noted."""
        while self.token.kind in ("bare", "text"):
            path = (*path, self.token.text.strip("\"'"))
            self.lines.setdefault(path, self.token.line)
            self.position += 1
            if not self.accept("."):
                break
        return path

    def pair(self, table: Path) -> None:
        path = self.key(table)
        if self.accept("="):
            self.value(path)
        elif self.token.kind != "end":
            self.position += 1

    def value(self, path: Path) -> None:
        if self.accept("["):
            index = 0
            while self.token.kind != "end" and not self.accept("]"):
                if not self.accept("\n", ","):
                    self.lines[(*path, index)] = self.token.line
                    self.value((*path, index))
                    index += 1
        elif self.accept("{"):
            while self.token.kind != "end" and not self.accept("}"):
                if not self.accept("\n", ","):
                    self.pair(path)
        else:
            while self.token.kind in ("bare", "text") or self.token.text == ".":
                self.position += 1
