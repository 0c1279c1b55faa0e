#!/usr/bin/env bash
# GTC 1.5.1: the phase of a phasor that is exactly 0 has the uncertainty 0, as if it were known exactly.
#
# The uncertainty of the phase grows as the phasor gets smaller. At 0, the reading of a lock-in at rest or of an averaged
# pair, `phase` and `atan2` return 0 with the uncertainty 0 and infinite degrees of freedom. `magnitude` raises an error
# there.
#
# Output seen (uncertainty 0.1 in both components; radians):
#   phase of 1: uncertainty 0.1
#   phase of 0.001: uncertainty 100
#   phase of 0: uncertainty 0
#   atan2 of 0, 0: uncertainty 0
#   magnitude of 0: ZeroDivisionError
#
# What to do: check that the magnitude is larger than its uncertainty before the phase is used.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check GTC==1.5.1
cd "$folder"
venv/bin/python - >output <<'PYTHON'
import GTC

for value in (1, 0.001, 0):
    phasor = GTC.ucomplex(complex(value), (0.1, 0.1))
    print(f"phase of {value}: uncertainty {GTC.uncertainty(GTC.phase(phasor)):.4g}")
component = GTC.ureal(0, 0.1)
print(f"atan2 of 0, 0: uncertainty {GTC.uncertainty(GTC.atan2(component, GTC.ureal(0, 0.1))):.4g}")
try:
    print("magnitude of 0:", GTC.uncertainty(GTC.magnitude(phasor)))
except ZeroDivisionError as error:
    print("magnitude of 0:", type(error).__name__)
PYTHON
cat output
diff output - <<'EXPECTED'
phase of 1: uncertainty 0.1
phase of 0.001: uncertainty 100
phase of 0: uncertainty 0
atan2 of 0, 0: uncertainty 0
magnitude of 0: ZeroDivisionError
EXPECTED
