#!/usr/bin/env bash
# OpenTURNS 1.27: a missing value counts as safe, and without a failure the confidence interval has the length 0.
#
# `ProbabilitySimulationAlgorithm` counts values above the limit. A model that returns NaN because a trial never
# settled is neither above nor below it, so the worst trials lower the probability of failure. The comparison is also
# false for NaN with `Less`. If no trial fails, the estimate is 0 and `getConfidenceLength(0.95)` is 0 for any number
# of trials; 3/n is the upper end of 95 %.
#
# Output seen (standard normal x, failure above 0.9, 1,000 trials):
#   every value known: 0.192
#   NaN above 1: 0.027
#   no failure in 300 trials: probability 0.0, length of the 95 % interval 0.0
#
# What to do: return infinity on the failing side instead of NaN, and compute the interval from the counts.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check openturns==1.27
cd "$folder"
venv/bin/python - >output 2>/dev/null <<'PYTHON'
import openturns as ot


def result(model, limit, trials):
    ot.RandomGenerator.SetSeed(1)
    values = ot.CompositeRandomVector(ot.PythonFunction(1, 1, model), ot.RandomVector(ot.Normal()))
    algorithm = ot.ProbabilitySimulationAlgorithm(ot.ThresholdEvent(values, ot.Greater(), limit))
    algorithm.setMaximumOuterSampling(trials)
    algorithm.setMaximumCoefficientOfVariation(0.0)
    algorithm.run()
    return algorithm.getResult()


known = lambda x: [x[0]]
missing = lambda x: [float("nan") if x[0] > 1 else x[0]]
print(f"every value known: {result(known, 0.9, 1000).getProbabilityEstimate():.3f}")
print(f"NaN above 1: {result(missing, 0.9, 1000).getProbabilityEstimate():.3f}")
none = result(known, 7.0, 300)
print(
    f"no failure in {none.getOuterSampling()} trials: probability {none.getProbabilityEstimate()}, "
    f"length of the 95 % interval {none.getConfidenceLength(0.95)}"
)
PYTHON
cat output
diff output - <<'EXPECTED'
every value known: 0.192
NaN above 1: 0.027
no failure in 300 trials: probability 0.0, length of the 95 % interval 0.0
EXPECTED
