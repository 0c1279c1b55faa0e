#!/usr/bin/env bash
# Pint 0.25.3: the range (`numpy.ptp`) of temperatures in °C is an absolute temperature: 2 °C becomes 275.15 K.
#
# A difference of offset temperatures has a unit of its own, `delta_degree_Celsius`. Subtraction, `diff`, `gradient`
# and `std` use it. `ptp`, the maximum minus the minimum, has °C, so its conversion to kelvin adds 273.15. No error is
# raised.
#
# Output seen (20, 21, 22 °C):
#   max - min: 2.0 delta_degree_Celsius = 2.0 kelvin
#   std: 0.82 delta_degree_Celsius = 0.82 kelvin
#   ptp: 2.0 degree_Celsius = 275.15 kelvin
#
# What to do: `values.max() - values.min()`, or convert to kelvin first.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check pint==0.25.3 numpy==2.4.6
cd "$folder"
venv/bin/python - >output <<'PYTHON'
import numpy as np
import pint

values = pint.UnitRegistry().Quantity(np.array([20.0, 21.0, 22.0]), "degC")
for name, result in (("max - min", values.max() - values.min()), ("std", np.std(values)), ("ptp", np.ptp(values))):
    print(f"{name}: {round(result, 2)} = {round(result.to('K'), 2)}")
PYTHON
cat output
diff output - <<'EXPECTED'
max - min: 2.0 delta_degree_Celsius = 2.0 kelvin
std: 0.82 delta_degree_Celsius = 0.82 kelvin
ptp: 2.0 degree_Celsius = 275.15 kelvin
EXPECTED
