"""Counts the trials of OpenTURNS for a coefficient of variation of 0.1: FORM, then importance sampling."""
import statistics

import openturns as ot

def trials(formula, dimensions, seed):
    ot.RandomGenerator.SetSeed(seed)
    names = [f"u{i}" for i in range(dimensions)]
    limit = ot.SymbolicFunction(names, [formula])
    normal = ot.Normal(dimensions)
    vector = ot.RandomVector(normal)
    event = ot.ThresholdEvent(ot.CompositeRandomVector(limit, vector), ot.LessOrEqual(), 0.0)
    before = limit.getCallsNumber() + limit.getGradientCallsNumber() * dimensions
    form = ot.FORM(ot.AbdoRackwitz(), event, [0.0] * dimensions)
    form.run()
    point = form.getResult().getStandardSpaceDesignPoint()
    used = limit.getCallsNumber() + limit.getGradientCallsNumber() * dimensions - before
    around = ot.Normal(point, ot.CovarianceMatrix(dimensions))
    run = ot.ProbabilitySimulationAlgorithm(ot.StandardEvent(event), ot.ImportanceSamplingExperiment(around))
    run.setMaximumCoefficientOfVariation(0.1)
    run.setBlockSize(1)
    run.setMaximumOuterSampling(100_000)
    run.run()
    return used + run.getResult().getOuterSampling(), run.getResult().getProbabilityEstimate()

for name, formula, dimensions in [
    ("linear 4.753", "4.753424-(" + "+".join(f"u{i}" for i in range(2)) + ")/sqrt(2)", 2),
    ("linear 4.753", "4.753424-(" + "+".join(f"u{i}" for i in range(5)) + ")/sqrt(5)", 5),
    ("linear 3", "3-(" + "+".join(f"u{i}" for i in range(6)) + ")/sqrt(6)", 6),
    ("curved 4, 0.1", "4-u0+0.1*u1^2", 3),
    ("curved 3.5, -0.05", "3.5-u0-0.05*u1^2", 4),
]:
    runs = [trials(formula, dimensions, seed) for seed in range(50)]
    print(name, dimensions, "median trials", statistics.median(run[0] for run in runs))
