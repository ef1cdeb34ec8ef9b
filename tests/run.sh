#!/usr/bin/env bash
# bash tests/run.sh [--release NAME] [ARGUMENTS OF PYTEST]
#
# Installs what is missing (on Debian, as root or with sudo) and runs the tests: without arguments all that are not
# slow, on all cores. With --release they run with the dolfinx of another Debian release: bookworm, trixie or sid
# (tests/release.sh).
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../.ci/setup.sh"

cd "$root"
if [ "${1-}" = --release ]; then
    exec bash tests/release.sh "${@:2}"
fi
setup pytest pytest-xdist hypothesis gmsh h5py pandas xarray
unset PYTHONDONTWRITEBYTECODE # every process that a test starts would compile the modules again
[ $# -gt 0 ] || set -- -n "$(env -u OMP_NUM_THREADS nproc)" --dist loadfile
exec "$python" -m pytest "$@" # of tests/, says pyproject.toml
