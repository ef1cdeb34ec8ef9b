# SPDX-License-Identifier: MIT
"""Measures of the project's English: `python -m tests.prose` prints them.

    python -m tests.prose --show PART               # the long and the vague sentences of a part
    python -m tests.prose --draw 300 --seed 1       # sentences drawn at random, with their places, for a reader

The text comes from docstrings, and from pages without code, rules of tables, comments and formulas. Code in a sentence
counts as one word. The noun of a *vague* word is missing or far away. A sentence ends at a full stop or colon, and at
the end of a paragraph, an item or a cell of a table.
"""

import ast
import re
import sys
from argparse import ArgumentParser
from collections import Counter
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from random import Random
from statistics import median

ROOT = Path(__file__).parents[1]
VAGUE = re.compile(r"\b(what|those|beside|besides|of which)\b", re.IGNORECASE)
LONG = 25
"""Words of the longest sentence that is easily read."""
PRIVATE = set(
    "told tells came owed said says apart beside amiss gone felt aslant lies foot offence begun began aloud loud mine "
    "lone sought borne fall falls rise rises way ways reach room travel drives resists stays taken spread turned turns "
    "met meets passed here there went back lost due wanted asked serves rederived uneven grips firm firmness "
    "sealed hoops smeared overfilled folded".split()
)
"""Verbs, participles and adverbs that name values in place of a noun of the field."""
ENTRY = re.compile(
    r"^( *)(\S(?:.{0,90}[^.:\s])?)\n\1 {4}(?=\S)|^( *)(?=\w[\w, ]* : |`?[\w/]+`? \([^)\n]*\)[^:\n]{0,20}: )", re.M
)
"""A name of a list of parameters, and its text below or after a colon."""
SHORTEST = 4
"""Words of the shortest sentence that is drawn."""
PARTS = {
    "package": lambda: docstrings(files("mpm_dolfinx")),
    "demos": lambda: docstrings(files("demos")),
    "front page": lambda: page(ROOT / "README.md"),
    "demos page": lambda: page(ROOT / "demos" / "README.md"),
    "method page": lambda: page(ROOT / "mpm_dolfinx" / "README.md"),
}
PAGES = ("README.md", "demos/README.md", "mpm_dolfinx/README.md")


def files(folder: str) -> list[Path]:
    """Return the Python files of a folder of the project."""
    return sorted((ROOT / folder).rglob("*.py"))


def texts(tree: ast.AST) -> list[tuple[int, str]]:
    """Return the lines and the values of all docstrings, also of the strings below values."""
    bodies = [node.body for node in ast.walk(tree) if isinstance(getattr(node, "body", None), list)]
    values = [child.value for body in bodies for child in body if isinstance(child, ast.Expr)]
    return [(each.lineno, each.value) for each in values if isinstance(each, ast.Constant) and type(each.value) is str]


def docstrings(paths: list[Path]) -> list[str]:
    """Return the paragraphs of all docstrings, also of the strings below values."""
    return [each for path in paths for _, text in texts(ast.parse(path.read_text())) for each in paragraphs(text)]


def messages(tree: ast.AST) -> list[tuple[int, str]]:
    """Return the lines and the texts of errors and warnings. A value in a message becomes `code`."""
    out = []
    for node in ast.walk(tree):
        warns = isinstance(node, ast.Call) and re.search(r"(warn\w*|refuse\w*)$", ast.unparse(node.func))
        parts = set()
        for each in ast.walk(node) if isinstance(node, ast.Raise) or warns else ():
            if each in parts:
                continue
            if isinstance(each, ast.JoinedStr):
                parts.update(ast.walk(each))
                text = [
                    v.value.replace("`", "") if isinstance(v, ast.Constant) else f"`{ast.unparse(v.value)}`"
                    for v in each.values
                ]
                out.append((each.lineno, "".join(text)))
            elif isinstance(each, ast.Constant) and isinstance(each.value, str):
                out.append((each.lineno, each.value))
    return sorted(set(out))


def page(path: Path) -> list[str]:
    """Return the paragraphs of a page, items and cells of tables among them."""
    return page_paragraphs(path.read_text())


def page_paragraphs(text: str) -> list[str]:
    """Return the paragraphs of the text of a page."""
    text = text.partition("\n## References\n")[0]
    text = re.sub(r"```.*?```|<!--.*?-->|\$\$.*?\$\$|<[^>]+>", " ", text, flags=re.S)
    text = re.sub(r"^ {4}.*$", "", text, flags=re.M)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    return paragraphs(text)


def paragraphs(text: str) -> list[str]:
    """Return the paragraphs of a text. Items, headings and cells of tables are paragraphs; code is excluded."""
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
    """Return the number of vague words per 1000 words, the share of long sentences, and the median length, in words."""
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


def private_names(trees: Iterable[ast.AST]) -> Counter[str]:
    """Return how often functions, fields, attributes, parameters and variables have a private name."""
    out: Counter[str] = Counter()
    for node in (node for tree in trees for node in ast.walk(tree)):
        stored = isinstance(getattr(node, "ctx", None), ast.Store)
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            name = node.name
        elif isinstance(node, ast.arg):
            name = node.arg
        else:
            name = getattr(node, "id", getattr(node, "attr", "")) if stored else ""
        if name.strip("_").lower() in PRIVATE:
            out[name.strip("_").lower()] += 1
    return out


def whole_sentences(paragraph: str) -> list[str]:
    """Return the sentences of a paragraph with at least `SHORTEST` words without code.

    In this function, a colon does not end a sentence.
    """
    code = iter(re.findall(r"``?[^`]+``?", paragraph))
    parts = re.split(r"(?<=[.!?])\s+(?![a-z])", re.sub(r"``?[^`]+``?", "\0", paragraph))
    whole = [part for part in parts if len(re.findall(r"[^\W\d_]+", part)) >= SHORTEST]
    shown = {part: re.sub("\0", lambda _: next(code), part) for part in parts}
    return [shown[part] for part in whole]


def entry(found: re.Match) -> str:
    """Return the name of a parameter as the beginning of a paragraph."""
    return f"\n{found[1]}{found[2]}: " if found[2] else f"\n{found[3]}"


@cache
def places() -> list[tuple[str, str]]:
    """Return the places, file:line, and all sentences of docstrings, messages and pages."""
    out = []
    for path in [*files("mpm_dolfinx"), *files("demos"), *(ROOT / page for page in PAGES)]:
        source = path.read_text()
        if path.suffix == ".md":
            found = [(1, each) for each in page_paragraphs(source)]
        else:
            tree = ast.parse(source)
            docs = [(line, each) for line, text in texts(tree) for each in paragraphs(ENTRY.sub(entry, text))]
            found = docs + [(line, " ".join(text.split())) for line, text in messages(tree)]
        out += [(place(path, source, line, each), each) for line, text in found for each in whole_sentences(text)]
    return out


def place(path: Path, source: str, line: int, sentence: str) -> str:
    """Return file:line of a sentence that begins at or below a line."""
    start = re.match(rf"(.*\n){{{line - 1}}}", source).end()
    words = r"[\W\d_]+".join(re.findall(r"[^\W\d_]+", sentence)[:5])
    found = re.search(words, source[start:])
    return f"{path.relative_to(ROOT)}:{line + (source.count(chr(10), start, start + found.start()) if found else 0)}"


def draw(count: int, seed: int) -> list[str]:
    """Return sentences drawn at random without repetition, with their places."""
    unique = {sentence: where for where, sentence in reversed(places())}
    drawn = Random(seed).sample(sorted(unique), count)
    return [f"{i + 1}. [{unique[each]}] {each}" for i, each in enumerate(drawn)]


if __name__ == "__main__":
    parser = ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--show", choices=PARTS, help="print the long and the vague sentences of a part")
    parser.add_argument("--draw", type=int, default=0, help="print so many sentences drawn at random")
    parser.add_argument("--seed", type=int, default=1, help="seed of the drawn sentences")
    args = parser.parse_args()
    if args.show:
        print("\n".join(poor(PARTS[args.show]())))
        sys.exit()
    if args.draw:
        print("\n".join(draw(args.draw, args.seed)))
        sys.exit()
    print(f"{'':12} {'words':>7} {'vague/1000':>11} {'long %':>7} {'median':>7}")
    for part, found in PARTS.items():
        m = measures(found())
        print(f"{part:12} {m['words']:7d} {m['vague']:11.2f} {m['long']:7.2f} {m['median']:7.0f}")
    names = private_names(ast.parse(path.read_text()) for path in files("mpm_dolfinx"))
    print(
        f"private names in the package: {names.total()}:", ", ".join(f"{name} {n}" for name, n in names.most_common())
    )
