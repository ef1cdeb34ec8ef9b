#!/usr/bin/env bash
# bash demos/run.sh [DEMO] [ARGUMENTS OF THE DEMO]
#
# Installs what is missing (on Debian, as root or with sudo) and runs demos/DEMO.py; without a name,
# the poroelastic beam. ARGUMENTS: see --help of the demo.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../.ci/setup.sh"

demo=poroelastic_beam
case ${1-} in
    "" | -*) ;;
    *) demo=$1 && shift ;;
esac
if [ ! -f "$root/demos/$demo.py" ]; then
    say "There is no demo $demo. There are:"
    (cd "$root/demos" && printf '    %s\n' *.py | sed 's/\.py$//') >&2
    exit 2
fi

setup
exec "$python" "$root/demos/$demo.py" "$@"
