# SPDX-License-Identifier: MIT
"""Measures of the project's English: `python -m tests.prose` prints them, with `--show PART` the sentences.

Text is that of docstrings and of pages without code, tables' rules, comments and formulas.  Code in a sentence counts
as one word.  *Vague* words are those behind which a noun is missing or far away.  A sentence ends at a full stop, a
colon, or at the end of a paragraph, of an item or of a cell of a table.
"""

import ast
import re
import sys
from pathlib import Path
from statistics import median

ROOT = Path(__file__).parents[1]
VAGUE = re.compile(r"\b(what|those|beside|besides|of which)\b", re.IGNORECASE)
LONG = 25
"""Words of the longest sentence that is easily read."""
PARTS = {
    "package": lambda: docstrings(sorted((ROOT / "mpm_dolfinx").rglob("*.py"))),
    "demos": lambda: docstrings(sorted((ROOT / "demos").rglob("*.py"))),
    "front page": lambda: page(ROOT / "README.md"),
    "demos page": lambda: page(ROOT / "demos" / "README.md"),
    "method page": lambda: page(ROOT / "mpm_dolfinx" / "README.md"),
}


def docstrings(paths: list[Path]) -> list[str]:
    """Return the paragraphs of all docstrings, also of the strings below values."""
    out = []
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text())):
            body = getattr(node, "body", None)
            for child in body if isinstance(body, list) else ():
                if (
                    isinstance(child, ast.Expr)
                    and isinstance(child.value, ast.Constant)
                    and type(child.value.value) is str
                ):
                    out += paragraphs(child.value.value)
    return out


def page(path: Path) -> list[str]:
    """Return the paragraphs of a page, items and cells of tables among them."""
    text = path.read_text().partition("\n## References\n")[0]
    text = re.sub(r"```.*?```|<!--.*?-->|\$\$.*?\$\$|<[^>]+>", " ", text, flags=re.S)
    text = re.sub(r"^ {4}.*$", "", text, flags=re.M)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    return paragraphs(text)


def paragraphs(text: str) -> list[str]:
    """Return the paragraphs of a text: items, headings and cells of tables are some of their own; code is not."""
    lines = [re.sub(r"^\s*(\* |- |\d+\. |#+ )", "\n", line) for line in text.split("\n")]
    lines = ["\n" if re.match(r"\s*[-=|: ]*$", line) else re.sub(r"(?<!\|)\|(?!\|)", "\n\n", line) for line in lines]
    return [" ".join(each.split()) for each in re.split(r"\n\s*\n", "\n".join(lines)) if each.strip()]


def sentences(paragraph: str) -> list[list[str]]:
    """Return the words of the sentences of a paragraph."""
    text = re.sub(r"``?[^`]+``?", "code", paragraph)
    text = re.sub(r"\b(e\.g|i\.e|Fig|eq|et al|Int|Methods|J)\.", r"\1", text)
    parts = re.split(r"(?<=[.!?:])\s+", text)
    return [words for part in parts if (words := re.findall(r"[^\W\d_][\w'’–-]*", part))]


def measures(texts: list[str]) -> dict[str, float]:
    """Return vague words in 1000 words, the share of long sentences, and the median length, words."""
    found = [words for text in texts for words in sentences(text)]
    lengths = [len(words) for words in found if len(words) > 2]
    words = sum(map(len, found))
    vague = sum(len(VAGUE.findall(re.sub(r"`[^`]+`", "", text))) for text in texts)
    long = sum(length > LONG for length in lengths) / len(lengths)
    return {"words": words, "vague": 1000 * vague / words, "long": 100 * long, "median": median(lengths)}


def poor(texts: list[str]) -> list[str]:
    """Return the sentences that are long or vague."""
    out = []
    for text in texts:
        bad = [words for words in sentences(text) if len(words) > LONG]
        out += [f"{len(words)} words: {' '.join(words)}" for words in bad]
        out += [f"{found}: {text}" for found in VAGUE.findall(re.sub(r"`[^`]+`", "", text))]
    return out


if __name__ == "__main__":
    if "--show" in sys.argv:
        print("\n".join(poor(PARTS[sys.argv[sys.argv.index("--show") + 1]]())))
        sys.exit()
    print(f"{'':12} {'words':>7} {'vague/1000':>11} {'long %':>7} {'median':>7}")
    for part, texts in PARTS.items():
        m = measures(texts())
        print(f"{part:12} {m['words']:7d} {m['vague']:11.2f} {m['long']:7.2f} {m['median']:7.0f}")
