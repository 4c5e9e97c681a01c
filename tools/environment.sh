# Sets up .venv for the scripts beside this file. Source it with the wanted extra, or none, as the first argument.
# A finished set-up is reused until pyproject.toml or the constraints change.

set -eu
# What these scripts start is started again and again, and would be compiled anew each time.
unset PYTHONDONTWRITEBYTECODE
root=$(cd "$(dirname "$0")/.." && pwd)
extra=${1:+[$1]}
venv="$root/.venv"
constraints="$root/tools/constraints.txt"

if [ "$(uname -s)" != Linux ]; then
    echo "armctl runs on Linux only (it needs pseudo terminals and Unix sockets); this is $(uname -s)." >&2
    exit 1
fi

python=
for candidate in ${ARMCTL_PYTHON:-} python3 python3.14 python3.13 python3.12 python3.11; do
    if command -v "$candidate" >/dev/null 2>&1 &&
        "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
        python=$candidate
        break
    fi
done
if [ -z "$python" ]; then
    found=$(python3 --version 2>/dev/null || echo "no python3")
    echo "armctl needs Python 3.11 or newer ($found found); install it, for example: sudo apt install python3.11 python3.11-venv" >&2
    exit 1
fi
if ! "$python" -c 'import venv, ensurepip' 2>/dev/null; then
    echo "$python cannot make virtual environments; install its venv module: sudo apt install python3-venv" >&2
    exit 1
fi

wanted=$(cat "$root/pyproject.toml" "$constraints" | cksum)
stamp="$venv/.installed$extra"
if [ ! -x "$venv/bin/python" ] || ! "$venv/bin/python" -c '' 2>/dev/null; then
    echo "Setting up $venv ..." >&2
    rm -rf "$venv"
    "$python" -m venv "$venv"
fi
if [ "$(cat "$stamp" 2>/dev/null)" != "$wanted" ]; then
    echo "Installing armctl$extra (a minute or two the first time) ..." >&2
    log="$venv/install.log"
    # Compiled is what is imported, then: a tenth of it, and all of it takes as long as everything else.
    if ! "$venv/bin/python" -m pip install --no-compile --disable-pip-version-check --constraint "$constraints" \
        --editable "$root$extra" >"$log" 2>&1; then
        tail -n 15 "$log" >&2
        echo "The installation failed; the whole log is in $log. Is the network up?" >&2
        exit 1
    fi
    echo "$wanted" >"$stamp"
fi
