# SPDX-License-Identifier: MIT
"""The English of pages and docstrings: numbers of vague words and long sentences only decrease."""

import re

import pytest

from tests import prose

CEILINGS = {  # vague words in 1000, and long sentences in 100: lowered with what is rewritten
    "package": (0.2, 0.8),
    "demos": (0.5, 2.0),
    "front page": (0.5, 2.0),
    "demos page": (0.5, 2.0),
    "method page": (0.5, 2.0),
}


PRIVATE_NAMES = 89  # of the package: lowered with each that is renamed


@pytest.mark.parametrize("part", prose.PARTS)
def test_prose_is_not_above_its_ceiling(part):
    found, (vague, long) = prose.measures(prose.PARTS[part]()), CEILINGS[part]
    assert found["words"] > 500
    assert found["vague"] <= vague and found["long"] <= long and found["median"] <= 14


def test_vague_words_and_long_sentences_are_counted():
    long = " ".join(["word"] * 26)
    texts = prose.paragraphs(f"What stands beside `those` names: three.\n\n* {long}. Of which\n* a short one.")
    found = prose.measures(texts)
    assert (
        found["words"] == 37 and found["vague"] == pytest.approx(3000 / 37) and found["long"] == pytest.approx(100 / 3)
    )
    assert len(prose.poor(texts)) == 4


def test_drawn_sentences_stand_where_they_are_said_to():
    drawn = prose.draw(200, seed=1)
    assert drawn == prose.draw(200, seed=1) != prose.draw(200, seed=2)
    for each in drawn:
        path, line, sentence = re.fullmatch(r"\d+\. \[(.+):(\d+)\] (.+)", each).groups()
        below = " ".join((prose.ROOT / path).read_text().splitlines()[int(line) - 1 :])
        words = [re.findall(r"[^\W\d_]+", text) for text in (re.sub(r"`.*?`", "", sentence), below)]
        assert set(words[0]) <= set(words[1])


def test_parameters_are_drawn_one_by_one():
    text = prose.ENTRY.sub(prose.entry, "x\n    Position of a node.\nz, y : m; height\nt : s; time")
    assert prose.paragraphs(text) == ["x: Position of a node.", "z, y : m; height", "t : s; time"]


def test_private_names_only_become_fewer():
    names = prose.private_names(prose.ast.parse(path.read_text()) for path in prose.files("mpm_dolfinx"))
    assert names.total() <= PRIVATE_NAMES


def test_private_names_of_functions_fields_parameters_and_variables_are_counted():
    code = "class A:\n    told: int\n    def _came(self, way, path):\n        self.gone = path.gone\n        lost = way"
    assert dict(prose.private_names([prose.ast.parse(code)])) == {"told": 1, "came": 1, "way": 1, "gone": 1, "lost": 1}
