#!/usr/bin/env bash
# Install the project into .venv: `tools/setup.sh run`, or `tools/setup.sh dev` with the tools of developers. And
# `tools/setup.sh cohort` installs the workflow engine into .venv-cohort: it wants other versions than a run does.
#
# Nothing is done when the stamp in the environment names the content of every file that decides the installation. As
# root on Debian or Ubuntu, missing system packages are installed; otherwise the command to type is shown and the exit
# code is 30.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

kind=${1:?run, dev or cohort}
case $kind in
run) lock=requirements.lock ;;
dev) lock=requirements-dev.lock ;;
cohort) lock=requirements-cohort.lock ;;
*) echo "tools/setup.sh: expected run, dev or cohort, got $kind" >&2; exit 20 ;;
esac
python=${PYTHON:-python3}
venv=.venv
[ "$kind" != cohort ] || venv=.venv-cohort
stamp=$venv/.setup-$kind

wanted() { { pwd; cat "$1" pyproject.toml tools/setup.sh; } | sha256sum; }
wanted_engine() { { pwd; cat "$lock"; } | sha256sum; }

stop() { # problem, what to do
    printf '%s\n%s\n' "$1" "$2" >&2
    exit 30
}

# A file name pattern that matches nothing stays as it is, and is no file.
any_file() { for file in "$@"; do [ -e "$file" ] && return 0; done; return 1; }

missing_packages() {
    "$python" -c 'import ensurepip, venv' 2>/dev/null || echo python3-venv
    any_file /usr/lib/*/libEGL.so.1 /usr/lib64/libEGL.so.1 || echo libegl1
    any_file /usr/lib/*/dri/swrast_dri.so /usr/lib64/dri/swrast_dri.so || echo libgl1-mesa-dri
    any_file /usr/lib/*/libpango-1.0.so.0 /usr/lib64/libpango-1.0.so.0 || echo libpango-1.0-0
    any_file /usr/lib/*/libpangoft2-1.0.so.0 /usr/lib64/libpangoft2-1.0.so.0 || echo libpangoft2-1.0-0
    any_file /usr/lib/*/libharfbuzz-subset.so.0 /usr/lib64/libharfbuzz-subset.so.0 || echo libharfbuzz-subset0
    any_file /usr/share/fonts/*/*/DejaVuSans.ttf /usr/share/fonts/*/DejaVuSans.ttf || echo fonts-dejavu-core
}

install_packages() {
    local packages command
    mapfile -t packages < <(missing_packages)
    [ ${#packages[@]} -gt 0 ] || return 0
    command="apt-get install -y --no-install-recommends ${packages[*]}"
    if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null; then
        stop "This machine lacks: ${packages[*]}." "Type (or ask your administrator to): sudo $command"
    fi
    echo "installing system packages: ${packages[*]}"
    { apt-get -qq update && DEBIAN_FRONTEND=noninteractive $command -qq >/dev/null; } ||
        stop "The system packages could not be installed: ${packages[*]}." "Check the network, then type: $command"
}

check_python() {
    "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null ||
        stop "Python 3.11 or newer is needed; '$python' is not." "Install it, or name one: make setup PYTHON=python3.12"
}

install_packages_of_lock() {
    { [ -x $venv/bin/python ] || "$python" -m venv $venv; } &&
        $venv/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes --requirement "$lock"
}

install_project() {
    install_packages_of_lock &&
        .venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
}

# Machine code is kept by the file of each kernel alone, so a change in one file would leave old code in another.
fresh_kernels() {
    local now
    now=$(cat pipeline/kinematics/direct/*.py pipeline/kinematics/compilation.py | sha256sum)
    [ "$(cat .venv/.kernels 2>/dev/null)" = "$now" ] && return 0
    rm -f pipeline/kinematics/direct/__pycache__/*.nb[ic]
    .venv/bin/ct2lut compile || stop "The solver could not be compiled." "Type: .venv/bin/ct2lut compile"
    echo "$now" >.venv/.kernels
}

# The engine needs nothing of the system but Python, and nothing of the project.
install_engine() {
    [ ! -x $venv/bin/snakemake ] || [ "$(cat "$stamp" 2>/dev/null)" != "$(wanted_engine)" ] || return 0
    check_python
    "$python" -c 'import ensurepip, venv' 2>/dev/null || stop "This machine lacks python3-venv." \
        "Type (or ask your administrator to): sudo apt-get install -y --no-install-recommends python3-venv"
    echo "installing the workflow engine into $venv (about 310 MB, a minute)"
    install_packages_of_lock ||
        stop "The workflow engine could not be installed." "Check the network and the free disk space, then run it again."
    wanted_engine >"$stamp"
}

if [ "$kind" = cohort ]; then
    install_engine
    exit 0
fi
if [ -x .venv/bin/python ] && [ "$(cat "$stamp" 2>/dev/null)" = "$(wanted "$lock")" ]; then
    fresh_kernels
    exit 0
fi
check_python
install_packages
echo "installing Python packages into .venv (about 1.5 GB, a few minutes)"
install_project || stop "The Python packages could not be installed." "Check the network and the free disk space, then run it again."
fresh_kernels
wanted "$lock" >"$stamp"
wanted requirements.lock >.venv/.setup-run # the developers' lock contains the other
