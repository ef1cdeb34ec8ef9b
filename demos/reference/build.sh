#!/usr/bin/env bash
# bash demos/run.sh reference | notebooks
#
# reference: the pages of the project and a reference from its docstrings, in out/reference/site. A broken link is an
# error. A page that loads files from the network is an error too. `python3 -m http.server -d out/reference/site` serves
# the pages with their search. Without a server, the page "All names" lists all public names.
# notebooks: the tutorial and three short examples in out/notebooks.
#
# The tools are installed in a separate Python environment, out/reference/venv, without dolfinx.
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)
out=$root/out/reference
python=$out/venv/bin/python
mkdir -p "$out"
tools=(mkdocs "mkdocstrings[python]" latex2mathml)
[ "$1" = reference ] || tools=(jupytext)
[ -x "$python" ] || python3 -m venv "$out/venv"
"$python" -c "import ${tools[-1]}" 2>/dev/null || "$python" -m pip install -q "${tools[@]}"

if [ "$1" = notebooks ]; then
    exec "$python" "$root/demos/reference/notebooks.py" "$root/out/notebooks"
fi
site=$out/site
"$python" "$root/demos/reference/pages.py" "$out/docs"
PYTHONPATH=$root/demos/reference "$python" -m mkdocs build --strict --quiet --clean -f "$root/demos/reference/mkdocs.yml"
if grep -rnoE "<(script|link|img|iframe)[^>]*(src|href)=\"?(https?:)?//[^\">]*" --include=*.html "$site"; then
    echo "These need the network." >&2
    exit 1
fi
echo "$site/index.html"
