#!/bin/sh
# make audit: compare requirements.lock with known vulnerabilities, by pip-audit in its own venv.
# Exit status 1: vulnerabilities found. 2: the advisory service cannot be reached from here.
set -u
cd "$(dirname "$0")/.." || exit 1

tool=.audit/bin/pip-audit
report=.audit/report
if [ ! -x "$tool" ]; then
    .venv/bin/python -m venv .audit && .audit/bin/python -m pip install --quiet pip-audit==2.9.0
    if [ ! -x "$tool" ]; then
        echo "audit: pip-audit cannot be installed from here: run make audit where pypi.org can be reached." >&2
        exit 2
    fi
fi

audit() {  # service, requirements
    "$tool" --requirement "$2" --no-deps --disable-pip --progress-spinner off \
        --vulnerability-service "$1" >"$report" 2>"$report.errors"
    grep -q '^Found [0-9]' "$report.errors"
}

echo 'jinja2==2.10' >.audit/control  # has known vulnerabilities since 2019: PYSEC-2019-217
for service in pypi osv; do
    # A mirror without advisories finds none, also where there are some.
    audit "$service" .audit/control || continue
    if audit "$service" requirements.lock; then
        cat "$report.errors" "$report"
        exit 1
    fi
    skipped=$(grep -c 'could not be audited' "$report")
    echo "audit: no known vulnerability in requirements.lock (service $service; $skipped packages are not known to it)."
    exit 0
done
echo "audit: no advisory service can be reached from here: run make audit where pypi.org or api.osv.dev can be reached." >&2
exit 2
