"""Feeds an FMU with the drive of a trace and compares its outputs with the trace, for several step sizes.

Prints a line per step size with the largest difference in µm; fails above 1e-9 µm or 1e-9 of the plate's U.
"""

import csv
import sys

import fmpy
from fmpy.fmi3 import FMU3Slave
from fmpy.validation import validate_fmu

LIMIT = 1e-9
STEPS_NS = [1_000_000, 500_000, 250_000, 50_000]


def simulate(fmu, description, folder, rows, step_ns):
    references = {variable.name: variable.valueReference for variable in description.modelVariables}
    inputs = [references[name] for name in ("drive", "frequency", "force", "temperature")]
    outputs = [references[name] for name in ("Wd", "Wq", "amplitude", "Ud", "Uq", "time")]
    slave = FMU3Slave(
        guid=description.guid,
        unzipDirectory=folder,
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="plate",
    )
    slave.instantiate()
    slave.enterInitializationMode()
    slave.exitInitializationMode()
    worst, now, applied = 0.0, 0, None
    for row in rows:
        at = round(float(row["t_s"]) * 1e9)
        # In whole steps, so that rows between two communication points are not compared.
        while now + step_ns <= at:
            if applied is not None:
                slave.setFloat64(inputs, applied)
            slave.doStep(currentCommunicationPoint=now / 1e9, communicationStepSize=step_ns / 1e9)
            now += step_ns
        if now == at:
            wd, wq, amplitude, ud, uq, time = slave.getFloat64(outputs)
            expected = [float(row[name]) for name in ("wd_um", "wq_um", "amplitude_um")]
            worst = max([worst, *(abs(a - b) for a, b in zip((wd, wq, amplitude), expected))])
            assert abs(time - at / 1e9) < 1e-12, (time, at)
            assert amplitude == 0 or abs(complex(ud, uq)) > 0, "U follows W"
        applied = [float(row[name]) for name in ("drive_vpp", "frequency_hz", "finger_force_n", "temperature_offset_k")]
    state = slave.getFMUState()
    before = slave.getFloat64(outputs)
    slave.doStep(currentCommunicationPoint=now / 1e9, communicationStepSize=1e-3)
    assert slave.getFloat64(outputs) != before
    slave.setFMUState(state)
    assert slave.getFloat64(outputs) == before
    slave.freeFMUState(state)
    slave.terminate()
    slave.freeInstance()
    return worst, now


def main(fmu, trace):
    problems = validate_fmu(fmu)
    assert not problems, problems
    with open(trace, newline="") as file:
        rows = list(csv.DictReader(file))
    description, folder = fmpy.read_model_description(fmu), fmpy.extract(fmu)
    for step_ns in STEPS_NS:
        worst, end = simulate(fmu, description, folder, rows, step_ns)
        assert end == 60_000_000, end
        assert worst <= LIMIT, f"{step_ns} ns: {worst} µm"
        print(f"{step_ns / 1e6} ms: {worst:.1e} µm")


main(*sys.argv[1:])
