# SPDX-License-Identifier: MIT
"""Convert formulas of pages to MathML, and link public names to the reference."""

import re
from pathlib import Path

from latex2mathml.converter import convert
from pages import documented

FOUND = documented(Path(__file__).with_name("pages"))


def on_page_markdown(markdown: str, **_) -> str:
    """Return the page with $$ formulas converted to MathML."""
    return re.sub(r"\$\$(.+?)\$\$", lambda m: convert(m[1].strip(), display="block"), markdown, flags=re.S)


def on_page_content(html: str, page, **_) -> str:
    """Return the page with links from public names in code to the reference."""
    up = "../" * page.url.count("/")

    def linked(m: re.Match) -> str:
        name = m[2]
        if name not in FOUND:
            return m[0]
        return f'<a href="{up}reference/{FOUND[name]}.html#mpm_dolfinx.{name}">{m[0]}</a>'

    return re.sub(
        r"<a\b.*?</a>|<h\d\b.*?</h\d>|<pre\b.*?</pre>|<code>(mpm\.)?(\w+)(?:\([^<]*)?</code>", linked, html, flags=re.S
    )
