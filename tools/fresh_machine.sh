#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0

# Tries README's quick start on an empty machine: tools/fresh_machine.sh SUITE [ARGUMENT...]
#
# SUITE is what debootstrap calls a distribution: bookworm, trixie, sid, noble, ... It is installed
# into a folder, without anything of this machine but the way to its network, with what README
# names: Python and make. There `make run` and `make test` are run on HEAD; ARGUMENTs go to
# `make test` (PYTEST="-n 2 test/unit"). Needs root, debootstrap and 4 GB in TMPDIR (/tmp).

set -euo pipefail
NAMED_IN_README="python3 make"
[ $# -ge 1 ] || { sed -n '/^# Tries/,/^$/s/^# \?//p' "$0" >&2; exit 2; }
[ "$(id -u)" = 0 ] || { echo "fresh_machine: error: needs root, for chroot" >&2; exit 2; }
command -v debootstrap > /dev/null || { echo "fresh_machine: error: apt install debootstrap" >&2; exit 2; }

suite=$1
shift
checkout=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
folder=$(mktemp -d)
root=$folder/root
trap 'rm -rf --one-file-system "$folder"' EXIT

# inside COMMAND...: in the new root, with mounts and processes that end with it
inside() {
    local passed=(PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/root TERM=dumb LC_ALL=C.UTF-8 DEBIAN_FRONTEND=noninteractive)
    local name
    for name in PIP_INDEX_URL PIP_DEFAULT_TIMEOUT {http,https,no}_proxy {HTTP,HTTPS,NO}_PROXY; do
        [ -z "${!name:-}" ] || passed+=("$name=${!name}")
    done
    [ ! -e "$root/root/ca.crt" ] || passed+=(PIP_CERT=/root/ca.crt)
    unshare --mount --pid --fork --kill-child sh -c '
        root=$1; shift
        mount -t proc proc "$root/proc"
        mount -t tmpfs tmpfs "$root/dev"
        for device in null zero full random urandom tty; do
            touch "$root/dev/$device"; mount --bind "/dev/$device" "$root/dev/$device"
        done
        mkdir "$root/dev/shm" "$root/dev/pts"
        mount -t tmpfs -o mode=1777 tmpfs "$root/dev/shm"
        mount -t devpts -o newinstance,ptmxmode=0666 devpts "$root/dev/pts"
        ln -s pts/ptmx "$root/dev/ptmx"; ln -s /proc/self/fd "$root/dev/fd"
        exec chroot "$root" env -i "$@"' inside "$root" "${passed[@]}" "$@"
}

# step NAME COMMAND...: run it; sets NAME to ok or failed, and NAME_s to its seconds
step() {
    local name=$1 begin=$SECONDS result=ok
    shift
    printf '\n== %s\n' "$*"
    inside sh -c 'cd /root/tactile_cdma && exec "$@"' step "$@" < /dev/null 2>&1 | tee "$folder/$name.log" || result=failed
    printf -v "$name" %s "$result"
    printf -v "${name}_s" %s "$((SECONDS - begin))"
}

echo "== debootstrap $suite"
debootstrap --variant=minbase "$suite" "$root" > "$folder/debootstrap.log" || { tail "$folder/debootstrap.log"; exit 1; }
cp /etc/resolv.conf /etc/hosts "$root/etc/"
echo 'Acquire::Check-Valid-Until "false";' > "$root/etc/apt/apt.conf.d/00network"  # a mirror of sid may lag
apt-config dump Acquire | grep -i proxy >> "$root/etc/apt/apt.conf.d/00network" || true
[ -z "${PIP_CERT:-}" ] || cp "$PIP_CERT" "$root/root/ca.crt"
mkdir "$root/root/tactile_cdma"
git -C "$checkout" archive HEAD | tar -x -C "$root/root/tactile_cdma"
inside apt-get -qq update
# shellcheck disable=SC2086
inside apt-get -qq install --no-install-recommends $NAMED_IN_README > "$folder/apt.log" 2>&1 || { tail "$folder/apt.log"; exit 1; }

step run make run SECONDS=5
step test make test "$@"

printf '\n== %s: %s; README names: %s\n' "$suite" "$(inside python3 --version)" "$NAMED_IN_README"
echo "installed besides, or missing:"
sed -nE 's/^\[0\/4\] apt-get (install .*)/  make run: \1/p; s/^firmware: apt-get (install .*)/  make test: \1/p; s/^(setup|firmware): .*needed on this machine: (.*)/  \1: \2/p' "$folder/run.log" "$folder/test.log"
sed -nE 's/^SKIPPED (.*)/  skipped \1/p' "$folder/test.log"
# shellcheck disable=SC2154
echo "run=$run test=$test run_s=$run_s test_s=$test_s"
[ "$run $test" = "ok ok" ]
