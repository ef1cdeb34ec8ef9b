# Sourced by demos/run.sh, tests/run.sh and tests/release.sh.
#
#   setup [MODULE...]   installs what is missing and sets $python, the interpreter that has dolfinx,
#                       this package, what the demos import and the MODULEs
#
# A module's Debian package is python3-MODULE, also that of a plugin of pytest (pytest-xdist, whose module is
# xdist). Nothing comes by pip: another numpy than Debian's would break Debian's petsc4py.

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
modules=(dolfinx scipy tqdm meshio matplotlib)

# One thread per process; pictures without a display; mpirun as root, as in a container; messages
# through shared memory, for everything runs on one machine (and Open MPI 5 warns about its network); more
# processes than cores are allowed (Open MPI 4's name for it, and 5's), and those that wait leave the core to others.
# Processes are bound to no core: otherwise Open MPI binds those of two runs at a time to the same cores.
# A process of its own has no daemon of Open MPI 4 beside it, whose end would be its own, without a word.
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
export MPLBACKEND="${MPLBACKEND:-Agg}"
export OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1
export OMPI_MCA_btl="${OMPI_MCA_btl:-^tcp}" OMPI_MCA_rmaps_base_oversubscribe=1 OMPI_MCA_mpi_yield_when_idle=1
export OMPI_MCA_ess_singleton_isolated=1
export OMPI_MCA_hwloc_base_binding_policy=none PRTE_MCA_hwloc_default_binding_policy=none
export PRTE_MCA_rmaps_default_mapping_policy="${PRTE_MCA_rmaps_default_mapping_policy:-:oversubscribe}"

say() { echo "$*" >&2; }

setup() {
    modules+=("$@")
    if ! command -v apt-get >/dev/null || has_dolfinx_of_its_own; then
        use_python_as_is
    else
        debian_install "${modules[@]/#/python3-}"
        advise_blas
        make_venv
    fi
}

# Is the first python in PATH one with a dolfinx that is not Debian's (conda-forge, say)?
has_dolfinx_of_its_own() {
    python3 -c 'import sys, dolfinx; sys.exit(dolfinx.__file__.startswith("/usr/lib/"))' >/dev/null 2>&1
}

use_python_as_is() {
    local module missing=()
    for module in "${modules[@]}"; do
        python3 -c "import ${module#pytest-}" >/dev/null 2>&1 && continue
        case $module in dolfinx) module=fenics-dolfinx ;; gmsh) module=python-gmsh ;; esac
        missing+=("$module")
    done
    if [ ${#missing[@]} -gt 0 ]; then
        say "Missing in python3: ${missing[*]}. Where there is no apt-get, install them first, for instance by"
        say "    conda install -c conda-forge ${missing[*]}"
        exit 1
    fi
    python=python3
    export PYTHONPATH="$root${PYTHONPATH:+:$PYTHONPATH}"
}

# debian_install PACKAGE...: apt-get those that are missing, by way of the command in $within, if any.
within=()
debian_install() {
    local package missing=() as_root=("${within[@]}")
    for package; do
        [ "$("${within[@]}" dpkg-query -W -f '${db:Status-Status}' "$package" 2>/dev/null)" = installed ] ||
            missing+=("$package")
    done
    [ ${#missing[@]} -gt 0 ] || return 0
    # MUMPS takes two to three times as long with the reference BLAS, which Debian takes where there is no other.
    ! reference_blas || missing+=(libopenblas0-serial)
    if [ "$(id -u)" != 0 ]; then
        { command -v sudo && sudo true; } >/dev/null || { without_root "${missing[@]}"; exit 1; }
        as_root=(sudo)
    fi
    say "Installing Debian's packages that are missing, by apt-get: ${missing[*]}"
    # A source that is out of reach need not matter: the installation tells.
    "${as_root[@]}" apt-get update -q >&2 || say "apt-get update failed, trying all the same"
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
        apt-get install -q -y --no-install-recommends -o DPkg::Lock::Timeout=600 -o Dpkg::Use-Pty=0 \
        "${missing[@]}" </dev/null >&2
}

# Is the reference BLAS the only one, or none there yet? In $within, if any.
reference_blas() {
    case $("${within[@]}" sh -c 'readlink -f /usr/lib/*/libblas.so.3') in
        *openblas* | *mkl* | *blis* | *atlas*) return 1 ;;
    esac
}

advise_blas() {
    ! reference_blas || say "Debian's reference BLAS makes MUMPS slow. Faster: apt-get install libopenblas0-serial"
}

without_root() {
    say "Missing: $*. As root: apt-get install $*"
    say "Without root: conda install -c conda-forge fenics-dolfinx scipy tqdm meshio matplotlib python-gmsh, then the same"
}

# A .venv on the system's own python, whichever comes first in PATH, for dolfinx belongs to that one.
# It sees Debian's modules, and this package by a .pth file: an editable installation without pip. Where the
# project's folder cannot be written, the system's python serves, and sees this package by PYTHONPATH.
make_venv() {
    local venv=$root/.venv site
    python=$venv/bin/python
    site=$(/usr/bin/python3 -c 'import sys; print("lib/python%d.%d/site-packages" % sys.version_info[:2])')
    export PYTHONNOUSERSITE=1 # a numpy in ~/.local would come before Debian's
    if [ ! -x "$python" ] || [ "$(cat "$venv/$site/mpm_dolfinx.pth" 2>/dev/null)" != "$root" ]; then
        if [ -x "$python" ] && [ "$(readlink -f "$python")" != "$(readlink -f /usr/bin/python3)" ]; then
            say "$venv is of another python than /usr/bin/python3: move it away, please"
            exit 1
        fi
        if ! { mkdir -p "$venv" && [ -w "$venv" ]; } 2>/dev/null; then
            say "$venv cannot be made: taking /usr/bin/python3. Results go to out/ in the present folder, or to --out."
            python=/usr/bin/python3
            export PYTHONPATH="$root${PYTHONPATH:+:$PYTHONPATH}"
            return
        fi
        /usr/bin/python3 -m venv --without-pip --system-site-packages "$venv"
        echo "$root" >"$venv/$site/mpm_dolfinx.pth"
    fi
}
