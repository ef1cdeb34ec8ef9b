# SPDX-License-Identifier: MIT
"""Formulas of pages as MathML, which browsers draw without a script."""

import re

from latex2mathml.converter import convert


def on_page_markdown(markdown: str, **_) -> str:
    """Return a page whose $$ formulas are MathML."""
    return re.sub(r"\$\$(.+?)\$\$", lambda m: convert(m[1].strip(), display="block"), markdown, flags=re.S)
