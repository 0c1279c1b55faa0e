#!/usr/bin/env python3
"""A controller of the plate in Python: `python3 controller.py PORT [BAUD]`.

Written from docs/wire-protocol.md alone; needs pyserial. Laws dq-pi and dq-pi-fixed. Paced by the bench.
Try it without a board:

    platebench run scenarios/paper/fig13-closed-loop.toml --rig "exec:python3 docs/examples/controller.py {port}"

Python pauses for garbage collection and other processes: this is an example, not for a real amplifier.
"""

import cmath
import math
import struct
import sys
import time
import zlib

try:
    import serial
except ImportError:
    sys.exit("controller.py: the module serial is missing; install it with `pip install pyserial`")

VERSION = 1
HELLO, IDENTITY, CONFIGURE, CONFIGURED, SAMPLE, COMMAND, SAFE = range(1, 8)
IDLE, RUNNING, FAULT, SAFE_STATE = range(4)
NOTHING, NO_SAMPLE, NOISE, NOT_FINITE = range(4)
SATURATED, FREQUENCY_LIMITED, FREQUENCY_HELD = 1, 2, 4
LAWS = DQ_PI, DQ_PI_FIXED = 1, 8
LONGEST = 70  # bytes of a frame, delimiter included
BODY_BYTES = {HELLO: 2, CONFIGURE: 54, SAMPLE: 18, SAFE: 2}
IGNORED = {IDENTITY: 50, CONFIGURED: 20, COMMAND: 18, 8: 20, 9: 6, 10: 6, 11: 37}


def now_us():
    return time.monotonic_ns() // 1000


def encode(body):
    """COBS( body, crc ), 0."""
    data = body + struct.pack("<I", zlib.crc32(body))
    return b"".join(bytes([len(piece) + 1]) + piece for piece in data.split(b"\0")) + b"\0"


def decode(frame):
    """The body of a frame without its delimiter; None if the frame is invalid."""
    data, at = bytearray(), 0
    while at < len(frame):
        piece = frame[at + 1 : at + frame[at]]
        if len(piece) != frame[at] - 1:
            return None
        data += piece
        at += frame[at]
        if at < len(frame):
            data.append(0)
    if len(data) < 4:
        return None
    body, crc = bytes(data[:-4]), struct.unpack("<I", data[-4:])[0]
    return body if zlib.crc32(body) == crc else None


class Loop:
    """u = Kp e + x, limited to its range; x tracks the limited value."""

    def __init__(self, kp, ki_ts, tracking_high=1.0):
        self.x, self.tracking_high = 0.0, tracking_high
        self.set_gains(kp, ki_ts)

    def set_gains(self, kp, ki_ts):
        self.kp, self.ki_ts = kp, ki_ts
        ratio = ki_ts / kp if kp > 0 else 1.0
        self.c_low, self.c_high = min(1.0, ratio), min(1.0, self.tracking_high * ratio)

    def step(self, e, low, high):
        u = self.kp * e + self.x
        limited = min(max(u, low), high)
        self.x += self.ki_ts * e + (self.c_high if limited < u else self.c_low) * (limited - u)
        return limited


class Plate:
    """The damping sigma of the plate, identified from one drive and the samples before and after it."""

    def __init__(self, period, k1, tau, reach):
        self.period, self.nominal, self.b, self.reach = period, 1 / tau, k1 / tau, reach
        self.sigma, self.suspected = 1 / tau, 0.0
        self.w, self.drive, self.offset = 0j, 0.0, 0.0

    def propagate(self, lam):
        """W after the period, and its derivative with respect to lambda."""
        z = lam * self.period
        exp = cmath.exp(z)
        small = abs(z) < 1e-3
        phi = 1 + z / 2 + z * z / 6 if small else (exp - 1) / z
        slope = 0.5 + z / 3 if small else (exp - phi) / z
        push = self.b * self.drive * self.period
        return exp * self.w + push * phi, self.period * (exp * self.w + push * slope)

    def identify(self, w):
        sigma, resonance = self.sigma, self.offset
        for _ in range(4):
            after, slope = self.propagate(complex(-sigma, resonance - self.offset))
            step = (w - after) / slope if slope else 0j
            sigma = min(max(sigma - step.real, self.nominal / 6), self.nominal * 6)
            resonance = min(max(resonance + step.imag, -self.reach), self.reach)
        return sigma

    def update(self, w):
        """Tracks sigma. True if two periods in a row agree on a change of more than a quarter."""
        change, least = self.identify(w) - self.sigma, 0.25 * self.sigma
        agreed = min(change, self.suspected) if change > 0 else max(change, self.suspected)
        self.suspected = 0.0
        if abs(change) <= least:
            self.sigma += change / 8
        elif agreed * change > 0 and abs(agreed) > least:
            self.sigma += agreed
            return True
        else:
            self.suspected = change
        return False


class DqPi:
    def __init__(self, law, period, k1, tau, response, limit, reach_hz, slew_hz, gains):
        self.limit, self.reach, self.slew = limit, 2 * math.pi * reach_hz, 2 * math.pi * slew_hz
        self.period, self.response = period, response or 1.9e-3
        self.plate = Plate(period, k1, tau, self.reach)
        self.adapts = law == DQ_PI and not gains
        self.gains = gains or self.design(1 / tau)
        kp_a, ki_a, kp_f, ki_f = self.gains
        self.amplitude = Loop(kp_a, ki_a * period, 0.6)
        self.frequency = Loop(kp_f, ki_f * period)
        self.offset = 0.0

    def design(self, sigma):
        """Gains for a plate with the static gains b/sigma and 1/sigma and the time constant 1/sigma."""
        a, p = math.exp(-sigma * self.period), math.exp(-3 * self.period / self.response)
        gains = ()
        for gain in (self.plate.b / sigma, 1 / sigma):
            kp = (1 - p) / (gain * (1 - a))
            gains += (kp, kp * (1 - a) / self.period)
        return gains

    def adapt(self, w):
        changed = self.plate.update(w)
        kp_a, ki_a, kp_f, ki_f = self.design(self.plate.sigma)
        self.amplitude.set_gains(kp_a, ki_a * self.period)
        self.frequency.set_gains(kp_f, ki_f * self.period)
        if changed:
            self.amplitude.x = self.plate.sigma * w.real / self.plate.b

    def step(self, setpoint, wd, wq):
        """Drive in Vpp, frequency above the start in Hz, flags."""
        w = complex(wd, wq)
        if self.adapts and setpoint > 0 and wd > 0.1 * setpoint:
            self.adapt(w)
        drive = self.amplitude.step(setpoint - wd, 0.0, self.limit)
        flags = SATURATED if drive >= self.limit else 0
        if setpoint > 0 and wd > 0.1 * setpoint:
            low = max(self.offset - self.slew, -self.reach)
            high = min(self.offset + self.slew, self.reach)
            self.offset = self.frequency.step(min(max(wq / wd, -2.0), 2.0), low, high)
            if not low < self.offset < high:
                flags |= FREQUENCY_LIMITED
        else:
            flags |= FREQUENCY_HELD
        self.plate.w, self.plate.drive, self.plate.offset = w, drive, self.offset
        return drive, self.offset / (2 * math.pi), flags


class Controller:
    def __init__(self):
        self.state, self.cause, self.flags = IDLE, NOTHING, 0
        self.drive, self.frequency = 0.0, 0
        self.law, self.number, self.compute = None, None, 0
        self.at = self.last_sample = self.timeout = self.start = self.noise = 0

    def command(self, number):
        bits = self.cause << 4 | self.flags
        numbers = self.at & 0xFFFFFFFF, self.drive, self.frequency, self.state, bits, min(self.compute, 0xFFFF)
        return encode(bytes([VERSION << 4 | COMMAND, number]) + struct.pack("<IfIBBH", *numbers))

    def stop(self, state, cause=NOTHING):
        self.state, self.cause, self.flags, self.drive = state, cause, 0, 0.0

    def answer(self, body):
        """The answer to the body of a frame, or None. Raises ValueError if the body must be rejected."""
        if len(body) < 2 or body[0] >> 4 != VERSION:
            raise ValueError("version")
        kind, number = body[0] & 0x0F, body[1]
        if len(body) != {**BODY_BYTES, **IGNORED}.get(kind):
            raise ValueError("kind or length")
        if kind in IGNORED:
            return None  # an echo, or for a controller with its own plate
        if kind == HELLO:
            name = b"python-example".ljust(16, b"\0")
            laws = 1 << DQ_PI | 1 << DQ_PI_FIXED
            who = bytes([0, 1, 0, 2]) + struct.pack("<I8sI12s16s", laws, bytes(8), 0, bytes(12), name)
            return encode(bytes([VERSION << 4 | IDENTITY, number]) + who)
        if kind == CONFIGURE:
            outcome, gains = self.configure(body)
            return encode(bytes([VERSION << 4 | CONFIGURED, number, outcome, 0]) + struct.pack("<4f", *gains))
        self.at = now_us()
        if kind == SAFE:
            self.stop(SAFE_STATE)
        elif number != self.number:
            self.number = number
            self.sample(*struct.unpack_from("<3f", body, 6))
        return self.command(number)

    def configure(self, body):
        law, bits, timeout_ms, period_us, start = struct.unpack_from("<BBHII", body, 2)
        k1, tau, response, limit, reach, slew, *gains = struct.unpack_from("<10f", body, 14)
        if law > 8 or bits & 0xF4:
            raise ValueError("field")
        self.law, self.number, self.noise = None, None, 0
        self.stop(IDLE)
        if law not in LAWS:
            return 2, (0.0,) * 4
        positive = all(math.isfinite(value) and value > 0 for value in (k1, tau, limit, reach, slew))
        usable = positive and period_us and start and math.isfinite(response) and response >= 0
        gains = tuple(gains) if bits & 1 else ()
        if not usable or not all(map(math.isfinite, gains)) or bits & 0x0A:
            return 1, (0.0,) * 4
        self.law = DqPi(law, period_us * 1e-6, k1, tau, response, limit, reach, slew, gains)
        self.start = self.frequency = start
        self.timeout = timeout_ms * 1000 or 5 * period_us
        return 0, self.law.gains

    def sample(self, setpoint, wd, wq):
        if self.state in (FAULT, SAFE_STATE) or self.law is None:
            return
        if self.state == RUNNING and self.at - self.last_sample >= self.timeout:
            return self.stop(FAULT, NO_SAMPLE)
        if not all(map(math.isfinite, (setpoint, wd, wq))):
            return self.stop(FAULT, NOT_FINITE)
        drive, offset, flags = self.law.step(setpoint, wd, wq)
        if not (math.isfinite(drive) and math.isfinite(offset)):
            return self.stop(FAULT, NOT_FINITE)
        self.state, self.drive, self.flags = RUNNING, drive, flags
        self.frequency = max(0, self.start + round(offset * 1000))
        self.last_sample, self.noise = self.at, max(0, self.noise - 1)

    def count_rejected(self):
        """Counts a rejected frame. Returns the command that reports the stop if there were too many."""
        if self.state == RUNNING:
            self.noise += 2
            if self.noise >= 10:
                return self.give_up(NOISE)
        return None

    def check_timeout(self):
        if self.state == RUNNING and now_us() - self.last_sample >= self.timeout:
            return self.give_up(NO_SAMPLE)
        return None

    def give_up(self, cause):
        self.at = now_us()
        self.stop(FAULT, cause)
        return self.command(self.number or 0)


def main():
    if len(sys.argv) not in (2, 3):
        sys.exit("usage: controller.py PORT [BAUD]")
    baud = int(sys.argv[2]) if len(sys.argv) == 3 else 1_000_000
    controller, received = Controller(), bytearray()
    try:
        # A read returns with the first byte, or after a millisecond to check the time.
        with serial.Serial(sys.argv[1], baud, timeout=0.001, write_timeout=10) as port:
            while True:
                received += port.read(max(1, port.in_waiting))
                *frames, rest = received.split(b"\0")
                # A longer remainder is no frame; keep enough to reject it.
                received = bytearray(rest[:LONGEST])
                for frame in filter(None, frames):
                    since = now_us()
                    body = decode(frame) if len(frame) < LONGEST else None
                    try:
                        answer = controller.count_rejected() if body is None else controller.answer(body)
                    except ValueError:
                        answer = controller.count_rejected()
                    if answer:
                        port.write(answer)
                    controller.compute = max(1, now_us() - since)
                answer = controller.check_timeout()
                if answer:
                    port.write(answer)
    except (serial.SerialException, OSError) as error:
        # The bench closes the line after it requested 0 V.
        if controller.number is not None and controller.drive == 0.0:
            return
        # A controller with an amplifier sets 0 V here.
        sys.exit(f"controller.py: {error}")


if __name__ == "__main__":
    main()
