"""Runs scenarios on the board of a labgrid place: its exporter publishes the serial port over TCP or RFC 2217."""

import os
import subprocess
import sys

from labgrid import Environment


def main() -> int:
    target = Environment(os.environ["LG_ENV"]).get_target("main")
    port = target.get_resource("NetworkSerialPort")
    if port.protocol == "rfc2217":
        rig = f"rfc2217:{port.host}:{port.port}@{port.speed}"
    else:
        rig = f"tcp:{port.host}:{port.port}"
    return subprocess.call(["platebench", "run", "--rig", rig, *sys.argv[1:]])


if __name__ == "__main__":
    sys.exit(main())
