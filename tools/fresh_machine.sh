#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0

# Tries README's quick start on an empty machine: tools/fresh_machine.sh [--arch arm64 | --order] SUITE [ARGUMENT...]
#
# SUITE is what debootstrap calls a distribution: bookworm, trixie, sid, noble, ... It is installed
# into a folder, without anything of this machine but the way to its network, with what README
# names: Python and make. There `make run` and `make test` are run on HEAD; ARGUMENTs go to
# `make test` (PYTEST="-n 2 test/unit"). Needs root, debootstrap and 4 GB in TMPDIR (/tmp).
#
# --arch: of another processor, emulated by qemu-user-static. There the quick tests from bytes to frames are run
# instead of all, which take too long, and `make dist`; tools/same_frames.py compares what is decoded with this machine's (make setup).
#
# --order: KiCad is installed, too, and `make order` is run instead of all this; trixie has KiCad 9.

set -euo pipefail
NAMED_IN_README="python3 make"
[ $# -ge 1 ] || { sed -n '/^# Tries/,/^$/s/^# \?//p' "$0" >&2; exit 2; }
[ "$(id -u)" = 0 ] || { echo "fresh_machine: error: needs root, for chroot" >&2; exit 2; }
command -v debootstrap > /dev/null || { echo "fresh_machine: error: apt install debootstrap" >&2; exit 2; }
arch=
order=
if [ "$1" = --order ]; then
    order=yes
    NAMED_IN_README="$NAMED_IN_README kicad kicad-footprints kicad-symbols poppler-utils"
    shift
fi
if [ "$1" = --arch ]; then
    arch=${2:?fresh_machine: error: --arch wants a processor of Debian: arm64}
    shift 2
fi

suite=${1:?fresh_machine: error: no SUITE}
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
    # That of a Raspberry Pi 4: with more, qemu 7.2 gives wrong products of OpenBLAS's SVE code.
    [ -z "$arch" ] || passed+=(QEMU_CPU=cortex-a72)
    [ ! -e "$root/root/ca.crt" ] || passed+=(PIP_CERT=/root/ca.crt)
    unshare --mount --pid --fork --kill-child sh -c '
        root=$1; shift
        mount --bind "$root" "$root" # a root that is no mount point takes no mounts of its own
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

# bootstrap: an empty Debian, in two stages for another processor
bootstrap() {
    debootstrap --variant=minbase ${arch:+--foreign --arch "$arch"} "$suite" "$root" || return
    [ -n "$arch" ] || return 0
    local formats=/proc/sys/fs/binfmt_misc emulator
    [ -e $formats/register ] || mount -t binfmt_misc binfmt_misc $formats || return
    for emulator in /usr/lib/binfmt.d/qemu-*.conf; do  # as systemd does where it runs
        emulator=$(basename "$emulator" .conf)
        [ -e "$formats/$emulator" ] || cat "/usr/lib/binfmt.d/$emulator.conf" > $formats/register || return
    done
    chroot "$root" /debootstrap/debootstrap --second-stage
}

echo "== debootstrap $suite $arch"
bootstrap > "$folder/debootstrap.log" 2>&1 || { tail "$folder/debootstrap.log"; exit 1; }
cp /etc/resolv.conf /etc/hosts "$root/etc/"
echo 'Acquire::Check-Valid-Until "false";' > "$root/etc/apt/apt.conf.d/00network"  # a mirror of sid may lag
apt-config dump Acquire | grep -i proxy >> "$root/etc/apt/apt.conf.d/00network" || true
[ -z "${PIP_CERT:-}" ] || cp "$PIP_CERT" "$root/root/ca.crt"
mkdir "$root/root/tactile_cdma"
git -C "$checkout" archive HEAD | tar -x -C "$root/root/tactile_cdma"
inside apt-get -qq update
# shellcheck disable=SC2086
inside apt-get -qq install --no-install-recommends $NAMED_IN_README > "$folder/apt.log" 2>&1 || { tail "$folder/apt.log"; exit 1; }

if [ -n "$order" ]; then
    step order make order
    # shellcheck disable=SC2154
    echo "$suite: order=$order order_s=$order_s"
    [ "$order" = ok ]
    exit
fi

step run make run SECONDS=5
if [ -n "$arch" ]; then
    "$checkout/.venv/bin/python" "$checkout/tools/same_frames.py" --write "$root/root/frames"
    step kernel .venv/bin/python -c 'from tactile_cdma.base import kernel'
    step same_bits .venv/bin/python tools/same_frames.py /root/frames
    step dist make dist
    step tests make core-tests CORE="base code wire words framing readings driver" PYTEST="-v --durations 20" "$@"
    # shellcheck disable=SC2154
    echo "$suite $arch: run=$run kernel=$kernel same_bits=$same_bits dist=$dist tests=$tests tests_s=$tests_s"
    [ "$run $kernel $same_bits $dist $tests" = "ok ok ok ok ok" ]
    exit
fi
step test make test "$@"

printf '\n== %s: %s; README names: %s\n' "$suite" "$(inside python3 --version)" "$NAMED_IN_README"
echo "installed besides, or missing:"
sed -nE 's/^\[0\/4\] apt-get (install .*)/  make run: \1/p; s/^firmware: apt-get (install .*)/  make test: \1/p; s/^(setup|firmware): .*needed on this machine: (.*)/  \1: \2/p' "$folder/run.log" "$folder/test.log"
sed -nE 's/^SKIPPED (.*)/  skipped \1/p' "$folder/test.log"
# shellcheck disable=SC2154
echo "run=$run test=$test run_s=$run_s test_s=$test_s"
[ "$run $test" = "ok ok" ]
