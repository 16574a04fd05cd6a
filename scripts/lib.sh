# shellcheck shell=bash
# Functions and variables of the other scripts. Sourced, never run.

# shellcheck disable=SC2034  # used by the scripts that source this file
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)

say() { printf '==> %s\n' "$*"; }
die() {
    printf 'error: %s\n' "$*" >&2
    exit 1
}

# cargo_tool NAME VERSION [ARGS of cargo install…]: sets `tool` to that program, and builds it into .tools if it is missing,
# with the optimisation TOOL_OPT_LEVEL (0).
cargo_tool() {
    local name=$1 version=$2
    shift 2
    tool=$root/.tools/bin/$name
    [ -x "$tool" ] && grep -qs "^\"$name $version " "$root/.tools/.crates.toml" && return
    if cargo install --list | grep -qx "$name v$version:"; then
        tool=$name
        return
    fi
    # Most of these programs run for seconds, and only their build takes long.
    say "building $name $version into .tools (a minute or two, once)"
    CARGO_PROFILE_RELEASE_OPT_LEVEL=${TOOL_OPT_LEVEL:-0} CARGO_PROFILE_RELEASE_LTO=off CARGO_PROFILE_RELEASE_DEBUG=0 \
        CARGO_TARGET_DIR=$root/.tools/target cargo install --quiet --locked --root "$root/.tools" --version "$version" "$@" "$name"
    rm -rf "$root/.tools/target"
}

# python_tool NAME REQUIREMENTS: sets `tool` to the Python environment .tools/NAME, and makes it if it does not have these.
python_tool() {
    tool=$root/.tools/$1
    cmp -s "$2" "$tool/installed.txt" && return
    say "Python environment in .tools/$1"
    python3 -m venv --clear "$tool"
    "$tool/bin/pip" install --quiet --disable-pip-version-check --only-binary :all: --no-binary empy -r "$2"
    cp "$2" "$tool/installed.txt"
}
