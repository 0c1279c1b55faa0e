#!/usr/bin/env bash
# SciPy 1.17.1: `ansari` finds a different spread in almost every pair of equal distributions if most values are
# equal, and `fligner` in two groups of one repeated value.
#
# Times that are whole control periods are mostly ties. `ansari` gives tied values the score of their mean rank
# instead of the mean of their scores, and compares with the expectation without ties. The share of false rejections
# at 5 % is then near 1. Two identical samples (18 times 5, one 4, one 6) give p = 0.002. `fligner` divides rounding
# errors by rounding errors if all values of both groups are equal: p is 1e-5 instead of NaN. `mood` and `levene` keep
# 5 %.
#
# Output seen:
#   two identical samples: ansari p 0.0020, mood p 1.0000, levene p 1.0000, fligner p 1.0000
#   ten equal values twice: ansari p 0.0148, mood p nan, levene p nan, fligner p 0.0000
#   one distribution, no ties: below 0.05 ansari 5.6 %, mood 4.6 %, levene 5.1 %, fligner 5.3 %
#   one distribution, 9 of 10 equal: below 0.05 ansari 99.8 %, mood 6.0 %, levene 4.8 %, fligner 5.3 %
#
# What to do: `levene` or `mood` for quantised values; check for constant groups first.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check numpy==2.4.6 scipy==1.17.1
cd "$folder"
venv/bin/python -W ignore - >output <<'PYTHON'
import numpy as np
from scipy import stats

names = ("ansari", "mood", "levene", "fligner")
shown = lambda text: ", ".join(f"{name} {text(getattr(stats, name))}" for name in names)
sample = np.array([5.0] * 18 + [4.0, 6.0])
print("two identical samples:", shown(lambda test: f"p {test(sample, sample).pvalue:.4f}"))
equal = np.full(10, 5.0)
print("ten equal values twice:", shown(lambda test: f"p {test(equal, equal).pvalue:.4f}"))
generator = np.random.default_rng(1)
mostly = [4.0] + [5.0] * 18 + [6.0]
for name, draw in (
    ("no ties", lambda: generator.normal(5, 1, 30)),
    ("9 of 10 equal", lambda: generator.choice(mostly, 30)),
):
    rejected = lambda test: np.mean([test(draw(), draw()).pvalue < 0.05 for _ in range(1000)])
    print(f"one distribution, {name}: below 0.05", shown(lambda test: f"{100 * rejected(test):.1f} %"))
PYTHON
cat output
diff output - <<'EXPECTED'
two identical samples: ansari p 0.0020, mood p 1.0000, levene p 1.0000, fligner p 1.0000
ten equal values twice: ansari p 0.0148, mood p nan, levene p nan, fligner p 0.0000
one distribution, no ties: below 0.05 ansari 5.6 %, mood 4.6 %, levene 5.1 %, fligner 5.3 %
one distribution, 9 of 10 equal: below 0.05 ansari 99.8 %, mood 6.0 %, levene 4.8 %, fligner 5.3 %
EXPECTED
