# Sourced by the other scripts: makes .venv and installs what "$1" (an extra, or nothing) needs, once per pyproject.toml.
# Leaves the environment's Python in $python.

root=$(CDPATH= cd -- "$(dirname -- "$0")/.." && pwd)
cd "$root"
export OPENBLAS_NUM_THREADS=1 # the processes share the cores already; threads of each one's own matrices wait for one another

say() { printf '%s\n' "$*" >&2; }

find_python() {
    for candidate in python3 python3.14 python3.13 python3.12 python3.11 python; do
        if command -v "$candidate" >/dev/null 2>&1 &&
            "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            printf '%s' "$candidate"
            return
        fi
    done
    say "fpirhc needs Python 3.11 or newer on the PATH."
    exit 1
}

set_up() {
    extra=$1
    python=.venv/bin/python
    if ! [ -x "$python" ] || ! "$python" -c '' 2>/dev/null; then
        say "making .venv"
        "$(find_python)" -m venv .venv || {
            say "python3 -m venv failed; some systems keep it in a package of its own, python3-venv."
            exit 1
        }
    fi
    stamp=.venv/.fpirhc-installed${extra:+-$extra}
    wanted=$("$python" -c 'import hashlib; print(hashlib.sha256(open("pyproject.toml", "rb").read()).hexdigest())')
    if ! [ -f "$stamp" ] || [ "$(cat "$stamp")" != "$wanted" ]; then
        say "installing${extra:+ (with $extra)}"
        "$python" -m pip install --quiet --disable-pip-version-check --editable ".${extra:+[$extra]}"
        printf '%s' "$wanted" >"$stamp"
    fi
    if [ -z "${FPIRHC_CC:-}${CC:-}" ] && ! command -v cc >/dev/null 2>&1 && ! command -v gcc >/dev/null 2>&1 &&
        ! command -v clang >/dev/null 2>&1; then
        say "no C compiler found: loops run in CasADi's virtual machine, more slowly"
    fi
}
