"""Advances many plates at once with numpy: closed form of the modal plate and two PI loops in double precision.

Prints the processor time of a trial of 60 ms, µs, and the settling time of a plate with the nominal gain, ms: from the
step at 1 ms to the last sample outside the band of 5 %. The gains are those of the zero-order-hold match
(docs/laws.md). No firmware, messages, crossings between samples, verdict or file.

Usage: numpy-batch.py PLATES [SAMPLES PER PERIOD] [START FREQUENCY, Hz]
"""
import math
import sys
import time

import numpy as np

plates, samples = int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1
periods, T = 60, 1e-3
random = np.random.default_rng(1)
before = time.process_time()
sigma, omega0, limit = 1 / 1.88e-3, 202_995.0, 900.0
start = 2 * math.pi * float(sys.argv[3]) if len(sys.argv) > 3 else omega0
gain = 0.00698 * (1 + 0.025 * random.standard_normal(plates))
gain[0] = 0.00698
force = 2 * sigma * omega0 * gain
a, pole = np.exp(-T * sigma), np.exp(-3 * T / 1.9e-3)
kv, kw = (1 - pole) / (0.00698 * (1 - a)), (1 - pole) * sigma / (1 - a)
damped = np.sqrt(omega0**2 - sigma**2)
plus, minus = complex(-sigma, damped), complex(-sigma, -damped)
w = np.zeros(plates, complex)
u = np.zeros(plates, complex)
vi = np.zeros(plates)
wi = np.full(plates, start)
settled = np.zeros(plates)
for period in range(periods):
    setpoint = 2.0 if period >= 1 else 0.0
    error = setpoint - w.real
    v = np.clip(kv * error + vi, 0.0, limit)
    vi = np.clip(vi + kv * (1 - a) * error, 0.0, limit)
    ratio = np.divide(w.imag, w.real, out=np.zeros(plates), where=w.real > 0.1)
    omega = wi + kw * ratio
    wi = wi + kw * (1 - a) * ratio
    frame = 1j * omega
    rest = 1j * force * v / (omega0**2 - omega**2 + 2j * sigma * omega)
    dw, du = w - rest, u - frame * rest
    slow = (du - minus * dw) / (plus - minus)
    fast = dw - slow
    slow_step, fast_step = np.exp((plus - frame) * (T / samples)), np.exp((minus - frame) * (T / samples))
    for sample in range(samples):
        slow, fast = slow * slow_step, fast * fast_step
        w = rest + slow + fast
        settled = np.where(np.abs(np.abs(w) - 2.0) > 0.1, period + (sample + 1) / samples, settled)
    u = frame * rest + plus * slow + minus * fast
assert 1.9 <= np.median(settled) <= 4, np.median(settled)
print((time.process_time() - before) / plates * 1e6, settled[0] - 1.0)
