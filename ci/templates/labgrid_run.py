"""Runs scenarios on the board of a labgrid place: its exporter publishes the serial port over TCP or RFC 2217.

Ends with 5 if the place has no such port, as if it is not acquired; otherwise with the exit code of the bench.
"""

import os
import sys

from labgrid import Environment

NO_RIG = 5


def find_rig() -> str:
    port = Environment(os.environ.get("LG_ENV", "labgrid.yaml")).get_target("main").get_resource("NetworkSerialPort")
    if port.protocol == "rfc2217":
        return f"rfc2217:{port.host}:{port.port}@{port.speed}"
    return f"tcp:{port.host}:{port.port}"


def main() -> int:
    try:
        rig = find_rig()
    except Exception as error:  # noqa: BLE001, because labgrid has no common class of its errors
        print(f"error: no board from labgrid: {error}; is the place acquired?", file=sys.stderr)
        return NO_RIG
    # The bench takes the place of this process, so that signals reach it.
    os.execvp("platebench", ["platebench", "run", "--rig", rig, *sys.argv[1:]])


if __name__ == "__main__":
    sys.exit(main())
