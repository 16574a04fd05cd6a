#!/usr/bin/env bash
# Installs the Debian or Ubuntu packages that are missing, and nothing else.
#   install-deps.sh build   requirements of the build
#   install-deps.sh test    the same, and those of the test suite
#   install-deps.sh dist    those of the build, of packages and of their test
#   install-deps.sh image   those of the build, of images and of their test
#   install-deps.sh bench   those of the build, of the systems beside SGC in `make bench`, and of counting instructions
# A requirement is met if its probe succeeds, whatever installed it. The script names each missing one with its reason, and
# installs the missing ones together.
set -euo pipefail
# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"

what=${1:-build}
packages=()

# need PROBE PACKAGES… -- REASON…: adds the packages if the probe fails.
need() {
    local probe=$1 wanted=()
    shift
    while [ "$1" != -- ]; do
        wanted+=("$1")
        shift
    done
    shift
    if ! eval "$probe" >/dev/null 2>&1; then
        say "missing: ${wanted[*]} ($*)"
        packages+=("${wanted[@]}")
    fi
}

# bindgen loads libclang.so, and needs the compiler headers of the -dev package.
has_libclang() {
    [ -n "${LIBCLANG_PATH:-}" ] || dpkg -s libclang-dev || compgen -G '/usr/lib/llvm-*/lib/libclang.so'
}

# compiles LANGUAGE HEADER: succeeds if a program that includes the header compiles.
compiles() {
    local compiler=cc
    [ "$1" = c++ ] && compiler=c++
    printf '#include <%s>\nint main() { return 0; }\n' "$2" | "$compiler" -x "$1" -fsyntax-only -
}

have_rust() {
    command -v cargo >/dev/null || die "cargo is not in PATH: install Rust first (rustup), then run this again"
    [ "$what" != test ] || for tool in rustfmt clippy; do
        cargo "${tool/rustfmt/fmt}" --version >/dev/null 2>&1 || die "missing: rustup component add $tool"
    done
}

case $what in build | test | dist | image | bench) ;; *) die "usage: install-deps.sh build|test|dist|image|bench" ;; esac
have_rust
need 'compiles c stdlib.h' gcc libc6-dev -- "C compiler: Cyclone DDS and AWS-LC are built from source"
need 'compiles c++ vector' g++ -- "C++ compiler: the build of Cyclone DDS requires one"
need 'command -v make' make -- "CMake drives it"
need 'command -v cmake' cmake -- "builds Cyclone DDS (crate cyclors)"
need has_libclang libclang-dev -- "bindgen makes the Rust bindings of Cyclone DDS"
need 'compiles c openssl/ssl.h' libssl-dev -- "DDS Security in Cyclone DDS, which is linked with the static library"
need 'command -v pkg-config' pkg-config -- "finds OpenSSL"
if [ "$what" = test ]; then
    need 'compiles c++ fastcdr/Cdr.h' libfastcdr-dev -- "the Fast DDS test peer"
    need 'compiles c++ fastdds/dds/domain/DomainParticipant.hpp' libfastrtps-dev -- "the Fast DDS test peer"
    need 'python3 -c "import venv, ensurepip"' python3 python3-venv -- "the Cyclone DDS test peer runs in a virtual environment"
    need 'command -v node && command -v npm' nodejs npm -- "clients of the gateway in JavaScript"
    # shellcheck disable=SC2016 # the probe is evaluated later
    need 'test -x "${SGC_CHROMIUM:-/usr/bin/chromium}"' chromium -- "a page that uses the gateway; SGC_CHROMIUM names another Chromium"
    need 'command -v certutil' libnss3-tools -- "a browser that has imported a gateway's certificate"
    need 'command -v ip' iproute2 -- "isolated networks for the tests (ip netns)"
    need 'command -v nft' nftables -- "NATs and firewalls between them"
    # The package leaves its service off unless debconf is told otherwise.
    need 'test -x /usr/sbin/miniupnpd' miniupnpd miniupnpd-nftables -- "a gateway that maps ports (PCP, NAT-PMP, UPnP-IGD)"
    need 'command -v redis-server && command -v redis-cli' redis-server -- "a store of names"
    need 'compgen -G "/usr/lib/*/faketime/libfaketimeMT.so.1"' libfaketime -- "nodes with wrong clocks"
    need 'command -v openssl' openssl -- "an independent DTLS program, a keystore for DDS Security"
fi
if [ "$what" = dist ]; then
    need 'command -v dpkg-shlibdeps' dpkg-dev -- "the package's dependencies on libraries"
    need 'command -v debootstrap' debootstrap -- "a small Debian to try the package on"
    need 'command -v systemd-nspawn' systemd-container -- "starts its systemd"
fi
if [ "$what" = image ]; then
    need 'command -v podman' podman runc netavark aardvark-dns iptables -- "builds and runs images"
    need 'command -v podman-compose' podman-compose -- "runs several containers"
    need 'command -v debootstrap' debootstrap -- "a small Debian to build the image on"
fi
if [ "$what" = bench ]; then
    need 'python3 -c "import venv, ensurepip"' python3 python3-venv -- "ROS 2 is installed into virtual environments"
    need 'command -v ip' iproute2 -- "separate networks for the compared systems (ip netns)"
    need 'command -v nft' nftables -- "NATs between two sites"
    need 'command -v wireguard-go' wireguard-go -- "DDS over WireGuard"
    need 'command -v wg' wireguard-tools -- "DDS over WireGuard: its keys"
    need 'command -v openssl' openssl -- "certificates for Zenoh over TLS, a keystore for DDS Security"
    need 'command -v ssh' openssh-client -- "files by SSH and SFTP"
    need 'test -x /usr/sbin/sshd' openssh-server -- "files by SSH and SFTP"
    need 'command -v valgrind' valgrind -- "counts instructions (make bench-instructions)"
fi
[ ${#packages[@]} -gt 0 ] || exit 0

command -v apt-get >/dev/null || die "apt-get is missing: install the equivalents of these packages yourself: ${packages[*]}"
sudo=()
if [ "$(id -u)" != 0 ]; then
    command -v sudo >/dev/null || die "not root and no sudo: ask an administrator for: apt-get install ${packages[*]}"
    sudo=(sudo)
    say "installing needs root, so sudo may ask for your password"
fi
say "installing from Debian's packages: ${packages[*]}"
"${sudo[@]}" apt-get update -qq
for package in "${packages[@]}"; do
    apt-cache show "$package" >/dev/null 2>&1 || die "this release of the system has no package $package (tested on Debian 12)"
done
"${sudo[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "${packages[@]}" >/dev/null
say "installed: ${packages[*]}"
