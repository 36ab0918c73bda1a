#!/bin/sh
# System packages that the build needs, with `dev` those of checks and tests too: installs what is missing by apt as
# root; otherwise prints the line to type.
set -u
PYTHON=${PYTHON:-python3}
WHOM=${1:-all}
missing=

need() { # need PACKAGE COMMAND...: the package unless the command succeeds
    package=$1
    shift
    "$@" >/dev/null 2>&1 || missing="$missing $package"
}
have() { command -v "$1"; }
header() { printf '#if !__has_include(<%s>)\n#error\n#endif\n' "$1" | "$2" -x c -E -; } # header NAME COMPILER
# Without clang: the version that Debian 12 has.
clang_major() { clang -dumpversion 2>/dev/null | grep -o '^[0-9]*' || echo 14; }
fuzzer_runtime() { test -f "$(clang -print-runtime-dir)/libclang_rt.fuzzer-$(uname -m).a"; }
python_header() { test -f "$("$PYTHON" -c 'import sysconfig; print(sysconfig.get_path("include"))')/Python.h"; }

missing_packages() {
    missing=
    need gcc have gcc
    need g++ have g++
    need libc6-dev header stdio.h gcc
    need make have make
    need cmake have cmake
    need ninja-build have ninja
    need libeigen3-dev header eigen3/Eigen/Core g++
    need python3 have "$PYTHON"
    need python3-venv "$PYTHON" -c 'import ensurepip, venv'
    need python3-dev python_header
    [ "$WHOM" = dev ] || return 0
    need pkg-config have pkg-config
    need clang have clang
    need clang-tidy have clang-tidy
    need "libclang-rt-$(clang_major)-dev" fuzzer_runtime
    need gcc-arm-none-eabi have arm-none-eabi-gcc
    need libnewlib-arm-none-eabi header math.h arm-none-eabi-gcc
    need qemu-system-arm have qemu-system-arm
    need xz-utils have xz
}

if [ "$PYTHON" != python3 ] && ! command -v "$PYTHON" >/dev/null; then
    echo "There is no $PYTHON (make PYTHON=... names the interpreter)" >&2
    exit 1
fi
missing_packages
if [ -n "$missing" ]; then
    if [ "$(id -u)" -ne 0 ] || ! command -v apt-get >/dev/null; then
        echo "Missing packages. Install them, then run make again:" >&2
        echo "    sudo apt-get install --no-install-recommends$missing" >&2
        exit 1
    fi
    echo "Installing by apt (a minute or two):$missing"
    export DEBIAN_FRONTEND=noninteractive
    # A list that is out of date, or none at all, shows as a failed install: then update and try once more.
    # shellcheck disable=SC2086  # one word a package
    apt-get install -qq -y --no-install-recommends $missing 2>/dev/null ||
        { apt-get update -qq; apt-get install -qq -y --no-install-recommends $missing; } || exit 1
    missing_packages
    if [ -n "$missing" ]; then
        echo "Installed, yet still not usable:$missing" >&2
        exit 1
    fi
fi

# Only the tests of the diagnosis page want a browser; they are skipped without one.
if [ "$WHOM" = dev ] && [ "${BROWSER:-1}" != 0 ] && ! have chromium >/dev/null; then
    if [ "$(id -u)" -eq 0 ] && have apt-get >/dev/null; then
        echo "Installing by apt, for the tests of the diagnosis page alone (BROWSER=0 leaves it out): chromium"
        DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends chromium >/dev/null 2>&1
    fi
    have chromium >/dev/null ||
        echo "No chromium: the tests of the diagnosis page in a browser will be skipped" >&2
fi

"$PYTHON" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || {
    echo "$PYTHON is $("$PYTHON" -V 2>&1); 3.11 or later is needed (make PYTHON=... names another)" >&2
    exit 1
}
