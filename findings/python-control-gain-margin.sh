#!/usr/bin/env bash
# python-control 0.10.2: finds no gain margin of a discrete loop whose phase reaches 180 degrees at half the sampling rate.
#
# L(z) = 1.9 / (z - 1) is a digital integrator with the gain 1.9. The pole of the closed loop is 1 - 1.9 k, so the loop
# is stable up to k = 2 / 1.9 = 1.0526. `margin` and `stability_margins` return an infinite gain margin, because they
# look for crossings of the real axis below half the sampling rate and this one lies exactly on it. The stability
# margin (0.05, the smallest distance from -1) is right.
#
# Output seen:
#   gain margin inf, stability margin 0.050
#   largest pole of the closed loop at gain 1.05: 0.995, at gain 1.06: 1.014
#
# What to do: for discrete loops, compute the poles over the gain, or use the stability margin.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check control==0.10.2 numpy==2.4.6 scipy==1.17.1
cd "$folder"
venv/bin/python -W ignore - >output <<'PYTHON'
import control

loop = control.tf([1.9], [1, -1], 1e-3)
gain_margin, _, stability_margin, *_ = control.stability_margins(loop)
assert control.margin(loop)[0] == gain_margin
print(f"gain margin {gain_margin}, stability margin {stability_margin:.3f}")
pole = lambda gain: max(abs(control.feedback(gain * loop).poles()))
print(f"largest pole of the closed loop at gain 1.05: {pole(1.05):.3f}, at gain 1.06: {pole(1.06):.3f}")
PYTHON
cat output
diff output - <<'EXPECTED'
gain margin inf, stability margin 0.050
largest pole of the closed loop at gain 1.05: 0.995, at gain 1.06: 1.014
EXPECTED
