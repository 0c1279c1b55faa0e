#!/usr/bin/env python3
"""A controller of the plate in Python: `python3 controller.py PORT [BAUD]`.

Written from docs/wire-protocol.md alone; needs pyserial. Laws dq-pi and dq-pi-fixed, which are the same here: the
gains do not follow the damping. Paced by the bench. Try it without a board:

    platebench run scenarios/paper/fig13-closed-loop.toml --rig "exec:python3 docs/examples/controller.py {port}"

Python stops for garbage collection and for other processes whenever it likes: this is an example, not for an amplifier with 400 V.
"""

import math
import struct
import sys
import time
import zlib

import serial

VERSION = 1
HELLO, IDENTITY, CONFIGURE, CONFIGURED, SAMPLE, COMMAND, SAFE = range(1, 8)
IDLE, RUNNING, FAULT, SAFE_STATE = range(4)
NOTHING, NO_SAMPLE, NOISE, NOT_FINITE = range(4)
SATURATED, FREQUENCY_LIMITED, FREQUENCY_HELD = 1, 2, 4
LAWS = DQ_PI, DQ_PI_FIXED = 1, 8
LONGEST = 70  # bytes of a frame, delimiter included
BODY_BYTES = {HELLO: 2, CONFIGURE: 54, SAMPLE: 18, SAFE: 2}
FROM_CONTROLLER = {IDENTITY: 50, CONFIGURED: 20, COMMAND: 18, 8: 20, 9: 6}


def now_us():
    return time.monotonic_ns() // 1000


def encode(body):
    """COBS( body, crc ), 0."""
    data = body + struct.pack("<I", zlib.crc32(body))
    return b"".join(bytes([len(piece) + 1]) + piece for piece in data.split(b"\0")) + b"\0"


def decode(frame):
    """The body of a frame without its delimiter; None where it is none."""
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
    """u = Kp e + x, held within its limits; x follows what was held."""

    def __init__(self, kp, ki_ts, tracking_high=1.0):
        self.kp, self.ki_ts, self.x = kp, ki_ts, 0.0
        ratio = ki_ts / kp if kp > 0 else 1.0
        self.c_low, self.c_high = min(1.0, ratio), min(1.0, tracking_high * ratio)

    def step(self, e, low, high):
        u = self.kp * e + self.x
        held = min(max(u, low), high)
        self.x += self.ki_ts * e + (self.c_high if held < u else self.c_low) * (held - u)
        return held


class DqPi:
    def __init__(self, period, k1, tau, response, limit, reach_hz, slew_hz, gains):
        if gains:
            self.gains = gains
        else:
            self.gains = ()
            for gain in (k1, tau):
                a, p = math.exp(-period / tau), math.exp(-3 * period / (response or 1.9e-3))
                kp = (1 - p) / (gain * (1 - a))
                self.gains += (kp, kp * (1 - a) / period)
        kp_a, ki_a, kp_f, ki_f = self.gains
        self.amplitude = Loop(kp_a, ki_a * period, 0.6)
        self.frequency = Loop(kp_f, ki_f * period)
        self.limit, self.reach, self.slew = limit, 2 * math.pi * reach_hz, 2 * math.pi * slew_hz
        self.offset = 0.0

    def step(self, setpoint, wd, wq):
        """Drive in Vpp, frequency above the start in Hz, flags."""
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
        return drive, self.offset / (2 * math.pi), flags


class Controller:
    def __init__(self):
        self.state, self.cause, self.flags = IDLE, NOTHING, 0
        self.drive, self.frequency = 0.0, 0
        self.law, self.number, self.compute = None, None, 0
        self.at = self.last_sample = self.patience = self.start = self.noise = 0

    def command(self, number):
        bits = self.cause << 4 | self.flags
        numbers = self.at & 0xFFFFFFFF, self.drive, self.frequency, self.state, bits, min(self.compute, 0xFFFF)
        return encode(bytes([VERSION << 4 | COMMAND, number]) + struct.pack("<IfIBBH", *numbers))

    def stop(self, state, cause=NOTHING):
        self.state, self.cause, self.flags, self.drive = state, cause, 0, 0.0

    def answer(self, body):
        """What is to be said to the body of a frame, or None; it raises ValueError where the body is to be refused."""
        if len(body) < 2 or body[0] >> 4 != VERSION:
            raise ValueError("version")
        kind, number = body[0] & 0x0F, body[1]
        if len(body) != {**BODY_BYTES, **FROM_CONTROLLER}.get(kind):
            raise ValueError("kind or length")
        if kind in FROM_CONTROLLER:
            return None  # an echo
        if kind == HELLO:
            name = b"python-example".ljust(16, b"\0")
            who = bytes([0, 1, 0, 2]) + struct.pack("<I8sI12s16s", 1 << DQ_PI | 1 << DQ_PI_FIXED, bytes(8), 0, bytes(12), name)
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
        law, bits, patience_ms, period_us, start = struct.unpack_from("<BBHII", body, 2)
        k1, tau, response, limit, reach, slew, *gains = struct.unpack_from("<10f", body, 14)
        if law > 8 or bits > 3:
            raise ValueError("field")
        self.law, self.number, self.noise = None, None, 0
        self.stop(IDLE)
        if law not in LAWS:
            return 2, (0.0,) * 4
        positive = all(math.isfinite(value) and value > 0 for value in (k1, tau, limit, reach, slew))
        usable = positive and period_us and start and math.isfinite(response) and response >= 0
        if not usable or not all(map(math.isfinite, gains)) or bits & 2:
            return 1, (0.0,) * 4
        self.law = DqPi(period_us * 1e-6, k1, tau, response, limit, reach, slew, tuple(gains) if bits & 1 else None)
        self.start = self.frequency = start
        self.patience = patience_ms * 1000 or 5 * period_us
        return 0, self.law.gains

    def sample(self, setpoint, wd, wq):
        if self.state in (FAULT, SAFE_STATE) or self.law is None:
            return
        if self.state == RUNNING and self.at - self.last_sample >= self.patience:
            return self.stop(FAULT, NO_SAMPLE)
        if not all(map(math.isfinite, (setpoint, wd, wq))):
            return self.stop(FAULT, NOT_FINITE)
        drive, offset, flags = self.law.step(setpoint, wd, wq)
        if not (math.isfinite(drive) and math.isfinite(offset)):
            return self.stop(FAULT, NOT_FINITE)
        self.state, self.drive, self.flags = RUNNING, drive, flags
        self.frequency = max(0, self.start + round(offset * 1000))
        self.last_sample, self.noise = self.at, max(0, self.noise - 1)

    def refused(self):
        """A frame that could not be read. The command to say where that was one too many."""
        if self.state == RUNNING:
            self.noise += 2
            if self.noise >= 10:
                return self.give_up(NOISE)
        return None

    def pass_time(self):
        if self.state == RUNNING and now_us() - self.last_sample >= self.patience:
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
    controller, heard = Controller(), bytearray()
    try:
        # A read comes back with the first byte, or after a millisecond to look at the time.
        with serial.Serial(sys.argv[1], baud, timeout=0.001, write_timeout=0.1) as port:
            while True:
                heard += port.read(max(1, port.in_waiting))
                *frames, rest = heard.split(b"\0")
                # Of a line that babbles no more is kept than shows that it does.
                heard = bytearray(rest[:LONGEST])
                for frame in filter(None, frames):
                    since = now_us()
                    body = decode(frame) if len(frame) < LONGEST else None
                    try:
                        said = controller.refused() if body is None else controller.answer(body)
                    except ValueError:
                        said = controller.refused()
                    if said:
                        port.write(said)
                    controller.compute = max(1, now_us() - since)
                said = controller.pass_time()
                if said:
                    port.write(said)
    except (serial.SerialException, OSError) as error:
        print(f"controller.py: {error}", file=sys.stderr)
        # Whoever drives an amplifier drives it to 0 V here.
        sys.exit(0 if controller.drive == 0.0 else 1)


if __name__ == "__main__":
    main()
