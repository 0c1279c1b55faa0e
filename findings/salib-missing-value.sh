#!/usr/bin/env bash
# SALib 1.6.0: one missing value makes all Sobol indices zero, with intervals of zero width and without an error.
#
# `SALib.analyze.sobol.analyze` of y = 2 a + b gives S1 = 0.80 and 0.20. With one NaN among 1,024 values, S1, ST and
# their confidence intervals are all 0: the result reads as "no input has an influence".
#
# Output seen:
#   complete: S1 [0.80, 0.20]
#   one NaN: S1 [0.00, 0.00], ST [0.00, 0.00], S1_conf [0.00, 0.00]
#
# What to do: check for NaN before the analysis; a trial without a value must be played again or modelled.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check SALib==1.6.0 numpy==2.4.6
cd "$folder"
venv/bin/python -W ignore - >output <<'PYTHON'
import numpy as np
from SALib.analyze import sobol as analysis
from SALib.sample import sobol as sample

problem = {"num_vars": 2, "names": ["a", "b"], "bounds": [[0, 1], [0, 1]]}
inputs = sample.sample(problem, 256, calc_second_order=False, seed=1)
values = 2 * inputs[:, 0] + inputs[:, 1]
text = lambda numbers: "[" + ", ".join(f"{number:.2f}" for number in numbers) + "]"
result = analysis.analyze(problem, values, calc_second_order=False, seed=1)
print(f"complete: S1 {text(result['S1'])}")
values[5] = np.nan
result = analysis.analyze(problem, values, calc_second_order=False, seed=1)
print("one NaN: " + ", ".join(f"{key} {text(result[key])}" for key in ("S1", "ST", "S1_conf")))
PYTHON
cat output
diff output - <<'EXPECTED'
complete: S1 [0.80, 0.20]
one NaN: S1 [0.00, 0.00], ST [0.00, 0.00], S1_conf [0.00, 0.00]
EXPECTED
