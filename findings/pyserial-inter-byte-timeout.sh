#!/usr/bin/env bash
# pySerial 3.5 on Linux: `inter_byte_timeout` does not end a read, and `in_waiting` of `socket://` is at most 1.
#
# With `inter_byte_timeout=0.05` a read is meant to end 50 ms after the last byte. `read` waits with `select` for the
# whole `timeout`, so an answer of unknown length takes the full second although its bytes came at once. The usual
# loop, `read(in_waiting)`, gets one byte per call over `socket://` (a serial server), because `in_waiting` is the
# number of readable sockets.
#
# Output seen (3 bytes on a pseudo terminal; 100 bytes on a socket; timeout 1 s):
#   read(100): 3 bytes, inter_byte_timeout 0.05: waited for the whole timeout
#   read(100): 3 bytes, inter_byte_timeout 0.2: waited for the whole timeout
#   socket://: 100 bytes arrived, in_waiting 1
#
# What to do: `read(1)`, then a short `timeout` for the rest; over `socket://` read a fixed length.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check pyserial==3.5
cd "$folder"
venv/bin/python - >output <<'PYTHON'
import os
import pty
import socket
import time
import tty

import serial

controller, terminal = pty.openpty()
tty.setraw(terminal)
for seconds in (0.05, 0.2):
    with serial.Serial(os.ttyname(terminal), 115200, timeout=1.0, inter_byte_timeout=seconds) as port:
        os.write(controller, b"abc")
        start = time.monotonic()
        count = len(port.read(100))
        waited = "waited for the whole timeout" if time.monotonic() - start >= 0.99 else "ended early"
        print(f"read(100): {count} bytes, inter_byte_timeout {seconds}: {waited}")

server = socket.create_server(("127.0.0.1", 0))
port = serial.serial_for_url(f"socket://127.0.0.1:{server.getsockname()[1]}", timeout=1.0)
peer, _ = server.accept()
peer.sendall(bytes(100))
while len(port._socket.recv(100, socket.MSG_PEEK)) < 100:
    time.sleep(0.01)
print(f"socket://: 100 bytes arrived, in_waiting {port.in_waiting}")
PYTHON
cat output
diff output - <<'EXPECTED'
read(100): 3 bytes, inter_byte_timeout 0.05: waited for the whole timeout
read(100): 3 bytes, inter_byte_timeout 0.2: waited for the whole timeout
socket://: 100 bytes arrived, in_waiting 1
EXPECTED
