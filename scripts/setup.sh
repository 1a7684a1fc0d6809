# Shared by the scripts here: makes .venv and installs the project into it. Sourced, not run.
# Needs bash, Python >= 3.11 and a C compiler.

say() { printf '\n==> %s   (%d s)\n' "$*" "$SECONDS"; } # of the script that says it
refuse() { printf '%s: %s\n' "$(basename "$0")" "$*" >&2; exit 2; }

# beside COMMAND...: runs it in the background; ended: waits for it, says what it said, and fails as it did.
beside() {
    beside_said="$(mktemp)"
    "$@" >"$beside_said" 2>&1 &
    beside_id=$!
}
ended() {
    local code=0
    wait "$beside_id" || code=$?
    cat "$beside_said"
    rm -f "$beside_said"
    return "$code"
}

# pip_into ENVIRONMENT ARGUMENTS...: pip install, there. Modules are compiled when they are first imported: of most
# packages, few ever are.
pip_into() {
    local home="$1"
    shift
    "$home/bin/python" -m pip install --disable-pip-version-check -q --no-compile "$@"
}

# install_into ENVIRONMENT ARGUMENTS...: the same by uv, which takes a fraction of the time. By pip where uv cannot be had
# or fails, and where pip was told of an index of its own, which uv would not ask.
install_into() {
    local home="$1" python="$1/bin/python"
    shift
    if "$python" -m pip config list 2>/dev/null | grep -Eq '\.(index-url|no-index)='; then
        pip_into "$home" "$@"
        return
    fi
    "$python" -m uv --version >/dev/null 2>&1 || pip_into "$home" uv -c constraints.txt >/dev/null 2>&1 || true
    "$python" -m uv pip install -q --system-certs --python "$python" "$@" 2>/dev/null || pip_into "$home" "$@"
}

# A command that runs a Python of at least 3.11; $PYTHON is asked first.
find_python() {
    local candidate
    for candidate in ${PYTHON:-} python3 python3.14 python3.13 python3.12 python3.11 python; do
        if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then
            printf '%s\n' "$candidate"
            return
        fi
    done
    return 1
}

# prepare_venv [dev]: .venv with the project, and with what its tests need.
prepare_venv() {
    local extra="${1:-}" target='.' stamp python fingerprint pin
    [ -n "$extra" ] && target=".[$extra]"

    command -v "${CC:-cc}" >/dev/null 2>&1 || command -v gcc >/dev/null 2>&1 || command -v clang >/dev/null 2>&1 ||
        refuse 'expected a C compiler (cc, gcc or clang) on the PATH, found none.' \
            'On Debian or Ubuntu: apt-get install gcc. On macOS: xcode-select --install.'

    if ! .venv/bin/python -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then
        python="$(find_python)" ||
            refuse "expected Python 3.11 or later, found $(python3 --version 2>/dev/null || echo none)." \
                'Install one, or name it: PYTHON=/path/to/python3.12' "$0"
        "$python" -c 'import ensurepip, venv' >/dev/null 2>&1 ||
            refuse "expected $python to have the modules venv and ensurepip." \
                'On Debian or Ubuntu: apt-get install python3-venv.'
        say "Making .venv with $("$python" --version)"
        rm -rf .venv
        "$python" -m venv .venv
    fi

    # What the installation depends on; unchanged means nothing to install.
    fingerprint="$(cat pyproject.toml constraints.txt | cksum) $(pwd)"
    for stamp in .venv/.installed-dev ".venv/.installed-$extra"; do
        if [ "$(cat "$stamp" 2>/dev/null)" = "$fingerprint" ]; then
            say 'The project is installed in .venv already'
            return
        fi
    done
    # torch first, pinned and by pip, which may have been told of a build for CPUs; others bring gigabytes for GPUs.
    pin="$(grep '^torch==' constraints.txt)"
    say "Installing $pin into .venv"
    pip_into .venv "$pin" -c constraints.txt
    say "Installing the project (editable) and what it needs into .venv"
    install_into .venv -c constraints.txt -e "$target"
    printf '%s\n' "$fingerprint" >".venv/.installed-$extra"
}
