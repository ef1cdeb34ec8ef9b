#!/usr/bin/env bash
# bash demos/run.sh [-n PROCESSES] [DEMO] [ARGUMENTS OF THE DEMO]
#
# Installs what is missing (on Debian, as root or with sudo) and runs demos/DEMO.py; without a name,
# the poroelastic beam. With -n on so many processes, by mpirun. ARGUMENTS: bash demos/run.sh DEMO --help.
# short/NAME is a short example; its files go to out/short. `reference` makes the pages of the reference, `notebooks`
# those of the tutorial and of three examples; both need pip, and take an environment of their own.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../.ci/setup.sh"

# The names of the demos, and the first line of what each says of itself.
demos() {
    (cd "$root/demos" && awk 'FNR == 2 && FILENAME != "common.py" {
        sub(/\.py$/, "", FILENAME); gsub(/"""/, ""); printf "    %-24s%s\n", FILENAME, $0 }' *.py short/*.py)
}

case ${1-} in
    -h | --help)
        sed -n '2,/^[^#]/s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"
        printf '\nDemos:\n\n'
        demos
        exit ;;
esac
case ${1-} in
    reference | notebooks) exec bash "$root/demos/reference/build.sh" "$@" ;;
esac
processes=
if [ "${1-}" = -n ]; then
    case ${2-} in
        "" | 0* | *[!0-9]*) say "-n ${2-}: must be a number of processes, such as -n 2"; exit 2 ;;
    esac
    processes=$2 && shift 2
fi
demo=poroelastic_beam
case ${1-} in
    "" | -*) ;;
    *) demo=$1 && shift ;;
esac
if [ ! -f "$root/demos/$demo.py" ] || [ "$demo" = common ]; then
    say "There is no demo $demo. There are:"
    demos >&2
    exit 2
fi

case $demo in
    embankment) modules+=(gmsh) ;;
    short/*) modules+=(gmsh h5py pandas) ;;
esac
setup
case $demo in short/*) mkdir -p "$root/out/short" && cd "$root/out/short" ;; esac
run=("$python" "$root/demos/$demo.py")
if [ -n "$processes" ]; then
    command -v mpirun >/dev/null || { say "mpirun is missing: on Debian, apt-get install openmpi-bin"; exit 1; }
    run=(mpirun -n "$processes" "$python" -m mpi4py "$root/demos/$demo.py") # where one process fails, all end
fi
exec "${run[@]}" "$@"
