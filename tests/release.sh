#!/usr/bin/env bash
# bash tests/run.sh --release NAME [ARGUMENTS OF PYTEST]
#
# Runs the tests in a tree of another Debian release, made once (some minutes, 2.5 GB) and kept in
# $MPM_DOLFINX_TREES, by default ~/.cache/mpm-dolfinx. Exit status 69: no such tree can be had here.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../.ci/setup.sh"

release=${1-}
case $release in
    "" | *[!a-z]*) say "usage: bash tests/run.sh --release bookworm|trixie|sid [ARGUMENTS OF PYTEST]"; exit 2 ;;
esac
shift
trees=${MPM_DOLFINX_TREES:-${XDG_CACHE_HOME:-$HOME/.cache}/mpm-dolfinx}
tree=$trees/$release

no_tree() {
    trap - EXIT
    say "No tree of Debian $release can be had here: $*"
    exit 69
}

if [ "$(id -u)" != 0 ]; then
    { command -v sudo && sudo true; } >/dev/null || no_tree "root or sudo is needed"
    exec sudo env MPM_DOLFINX_TREES="$trees" http_proxy="${http_proxy-}" https_proxy="${https_proxy-}" \
        bash "$root/tests/release.sh" "$release" "$@"
fi

# Run a command in the tree, in the project's folder, which it cannot write to. The mounts are in a
# namespace of the command's own: they end with it, however it ends, and touch no others.
in_tree() {
    unshare --mount bash -euc '
        root=$1 tree=$2
        shift 2
        mkdir -p "$tree/src"
        mount --bind "$root" "$tree/src"
        mount -o remount,bind,ro "$tree/src"
        for dir in proc sys dev; do mount --rbind "/$dir" "$tree/$dir"; done
        exec chroot "$tree" /usr/bin/env -i -C /src PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root LANG=C.UTF-8 \
            http_proxy="${http_proxy-}" https_proxy="${https_proxy-}" "$@"
    ' in_tree "$root" "$tree" "$@"
}

# The Debian archive that apt is configured with, or nothing.
debian_mirror() {
    local uri
    uri=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' 'Label: Debian' | sed -n '1s,/$,,p')
    case $uri in
        mirror+file:*) sed -n '/:/{s/[[:space:]].*//p;q}' "${uri#mirror+file:}" ;; # as in Debian's cloud images
        *) echo "$uri" ;;
    esac
}

make_base() {
    local mirror
    debian_install debootstrap
    mirror=$(debian_mirror)
    if [ -z "$mirror" ]; then
        apt-get update -q >&2
        mirror=$(debian_mirror)
    fi
    [ -n "$mirror" ] || no_tree "apt names no Debian archive"
    # Under its own name only when it is whole: a name.part is one that was broken off.
    rm -rf --one-file-system "$tree.part"
    unshare --mount debootstrap --variant=minbase --include=ca-certificates "$release" "$tree.part" "$mirror" >&2
    printf '#!/bin/sh\nexit 101\n' >"$tree.part/usr/sbin/policy-rc.d" # start no services
    chmod +x "$tree.part/usr/sbin/policy-rc.d"
    mv "$tree.part" "$tree"
}

trap 'no_tree "see above"' EXIT # until the tests begin
command -v apt-get >/dev/null || no_tree "this is no Debian"
unshare --mount true 2>/dev/null || no_tree "mounting is not allowed"
mkdir -p "$trees"
exec 9>"$tree.lock"
flock 9 # one at a time makes the tree
[ -d "$tree" ] || make_base
cat /etc/resolv.conf >"$tree/etc/resolv.conf" 2>/dev/null || true
{
    echo 'APT::Get::Fix-Broken "true";' # goes on where it was broken off
    # A mirror's sid may be some weeks old, and then counts as expired.
    [ "$release" != sid ] || echo 'Acquire::Check-Valid-Until "false";'
} >"$tree/etc/apt/apt.conf.d/99mpm-dolfinx"
within=(in_tree)
in_tree dpkg --configure -a >&2 || true
debian_install "${modules[@]/#/python3-}" python3-pytest python3-pytest-xdist python3-hypothesis
debian_install python3-gmsh || say "No gmsh: its tests are skipped"
in_tree apt-get clean
exec 9>&-
trap - EXIT

[ $# -gt 0 ] || set -- -n "$(env -u OMP_NUM_THREADS nproc)" --dist loadfile
in_tree OMP_NUM_THREADS="$OMP_NUM_THREADS" MPLBACKEND="$MPLBACKEND" OMPI_MCA_btl="$OMPI_MCA_btl" \
    OMPI_ALLOW_RUN_AS_ROOT=1 OMPI_ALLOW_RUN_AS_ROOT_CONFIRM=1 OMPI_MCA_mpi_yield_when_idle=1 PYTHONPATH=/src PYTHONPYCACHEPREFIX=/root/.cache/python \
    python3 -m pytest -p no:cacheprovider "$@"
