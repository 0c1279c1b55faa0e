#!/usr/bin/env bash
# libcosimpy 0.0.6 (libcosim): the file observer writes six significant digits, of values and of the time.
#
# `CosimObserver.create_to_dir` writes the CSV files that a co-simulation is evaluated from. A resonance of 202450.625
# rad/s becomes 202451, so steps below 1 rad/s (0.16 Hz) vanish, and times above 1 s are rounded to 10 µs: rows then
# have equal times. The values in the simulation are exact.
#
# Output seen (steps of 0.5000001 s):
#   simulation: 202450.625, file: 202451
#   simulation: 1.0000002 s, file: 1
#
# What to do: read the values with the observer `create_last_value` or a time series observer, and write them.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check libcosimpy==0.0.6 pythonfmu==0.7.0
cd "$folder"
cat >plate.py <<'PYTHON'
from pythonfmu import Fmi2Causality, Fmi2Slave, Real


class Plate(Fmi2Slave):
    def __init__(self, **arguments):
        super().__init__(**arguments)
        self.resonance = 0.0
        self.register_variable(Real("resonance", causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        self.resonance = 202450.625
        return True
PYTHON
venv/bin/pythonfmu build -f plate.py >log 2>&1
mkdir results
venv/bin/python - >log 2>&1 <<'PYTHON'
import glob

from libcosimpy.CosimExecution import CosimExecution
from libcosimpy.CosimObserver import CosimObserver
from libcosimpy.CosimSlave import CosimLocalSlave

execution = CosimExecution.from_step_size(step_size=500_000_100)
plate = execution.add_local_slave(CosimLocalSlave(fmu_path="Plate.fmu", instance_name="plate"))
last, file = CosimObserver.create_last_value(), CosimObserver.create_to_dir("results")
execution.add_observer(last)
execution.add_observer(file)
execution.simulate_until(target_time=1_000_000_200)
value = last.last_real_values(slave_index=plate, variable_references=[0])[0]
time = execution.status().current_time / 1e9
del execution, last, file
row = open(glob.glob("results/*.csv")[0]).read().split()[-1].split(",")
with open("output", "w") as output:
    output.write(f"simulation: {value}, file: {row[2]}\nsimulation: {time} s, file: {row[0]}\n")
PYTHON
cat output
diff output - <<'EXPECTED'
simulation: 202450.625, file: 202451
simulation: 1.0000002 s, file: 1
EXPECTED
