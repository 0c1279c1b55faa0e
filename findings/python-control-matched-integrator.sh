#!/usr/bin/env bash
# python-control 0.10.2: `sample_system(..., method="matched")` of a controller with an integrator is a transfer function
# whose numerator is NaN. It raises no error.
#
# The method makes the gains of both systems equal at zero frequency. With a pole at s = 0, as in every PI controller,
# both gains are infinite, and their quotient is NaN; the only sign is a RuntimeWarning of numpy. The poles are right.
# The other methods return numbers.
#
# Output seen:
#   matched, plant: numerator [0.002879], denominator [1.0, -0.587488]
#   matched, PI controller: numerator [nan, nan], denominator [1.0, -1.0]
#   tustin, PI controller: numerator [0.5064, -0.2936], denominator [1.0, -1.0]
#
# What to do: match the zero of the controller by hand: Kp (z - e^(-Ki T/Kp)) / (z - 1), with the gain of your choice.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check control==0.10.2 numpy==2.4.6 scipy==1.17.1
cd "$folder"
venv/bin/python -W ignore - >output <<'PYTHON'
import control

PERIOD = 1e-3
plant = control.tf([0.00698 * 531.9], [1, 531.9])
controller = control.tf([0.4, 212.8], [1, 0])
for method, name, system in (("matched", "plant", plant), ("matched", "PI controller", controller),
                             ("tustin", "PI controller", controller)):
    sampled = control.sample_system(system, PERIOD, method=method)
    numerator, denominator = ([round(float(x), 6) for x in part[0][0]] for part in (sampled.num, sampled.den))
    print(f"{method}, {name}: numerator {numerator}, denominator {denominator}")
PYTHON
cat output
diff output - <<'EXPECTED'
matched, plant: numerator [0.002879], denominator [1.0, -0.587488]
matched, PI controller: numerator [nan, nan], denominator [1.0, -1.0]
tustin, PI controller: numerator [0.5064, -0.2936], denominator [1.0, -1.0]
EXPECTED
