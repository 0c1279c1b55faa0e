#!/usr/bin/env bash
# lmfit 1.3.4: a fit whose start value is exactly at a bound of its parameter reports "Fit succeeded" far from the optimum.
#
# For a parameter with `min` and `max`, the optimiser varies an angle u with value = min + (sin u + 1)(max - min)/2. At a
# bound the derivative of the value by u is 0, so the parameter hardly moves and the optimiser finds that nothing
# changes. `success` is True, and the wrong value has an error bar. A start 0.1 inside of the bound finds the optimum.
#
# Seen with data that are exactly 2 e^(-x/3), the bounds 1 and 50, and the start values 49.9 and 50: a time constant of
# 3.000 with a sum of squares below 1e-20, and of 7.657 with a sum of 5.564. Both say "Fit succeeded".
#
# Output seen:
#   start 49.9: success True, right True
#   start 50.0: success True, right False
#
# What to do: start inside of the bounds, and compare the sum of squares with that of another start value.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check lmfit==1.3.4 numpy==2.4.6 scipy==1.17.1
cd "$folder"
venv/bin/python - >output <<'PYTHON'
import lmfit
import numpy

x = numpy.linspace(0, 10, 50)
y = 2 * numpy.exp(-x / 3)
model = lmfit.Model(lambda x, amplitude, tau: amplitude * numpy.exp(-x / tau))
for start in (49.9, 50.0):
    parameters = model.make_params(amplitude=1.0, tau=dict(value=start, min=1.0, max=50.0))
    fit = model.fit(y, parameters, x=x)
    print(f"start {start}: success {fit.success}, right {abs(fit.params['tau'].value - 3) < 0.01}")
PYTHON
cat output
diff output - <<'EXPECTED'
start 49.9: success True, right True
start 50.0: success True, right False
EXPECTED
