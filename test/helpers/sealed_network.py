"""A command without a way out of the machine, and a record of everything that it tried to send.

It runs in a network of its own (``unshare -rn``) in which every address is routed to the loopback device.  There each
packet is seen, whichever library, thread or child process sends it: a look-up as a packet to port 53.

As a program inside such a network, ``sealed_network.py RECORD SECONDS AFTER COMMAND ...`` writes the record as JSON.
"""

import ipaddress
import json
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

PATIENCE = 600
"""Seconds: a loaded machine may have to compile."""
_ALL_PROTOCOLS, _IPV4, _IPV6 = 0x0003, 0x0800, 0x86DD
_NAMES, _DISCARD = 53, 9
_TCP, _UDP = 6, 17
_OUTGOING = 4
"""Type of a packet as its sender sees it; the loopback device shows each one to its receiver too."""
_PROBE = "192.0.2.255"
_SETUP = ("ip link set lo up", "ip route add local default dev lo", "ip -6 route add local default dev lo")


@dataclass(frozen=True)
class Sealed:
    """What became of a command: exit code, what it said, and what it tried to send elsewhere."""

    code: int
    said: str
    sent: tuple[str, ...]


def require() -> None:
    """Skip the test where such a network cannot be made."""
    if not all(shutil.which(name) for name in ("unshare", "ip")):
        pytest.skip("needs the programs unshare and ip")
    made = subprocess.run(["unshare", "-rn", "sh", "-ec", "; ".join(_SETUP[:2])], capture_output=True, check=False)
    if made.returncode:
        pytest.skip(f"no network of one's own: {made.stderr.decode().strip()}")


def run(
    command: Sequence[str], environment: Mapping[str, str], folder: Path, seconds: float, after: str = ""
) -> Sealed:
    """Run a command to its end, or interrupt it, as Ctrl-C does, so many seconds after it has said ``after``."""
    record = folder / "record.json"
    sealed = ["unshare", "-rn", sys.executable, __file__, str(record), str(seconds), after, *command]
    done = subprocess.run(sealed, env=dict(environment), capture_output=True, text=True, cwd=folder, check=False)
    assert record.is_file(), done.stderr
    found = json.loads(record.read_text())
    record.unlink()
    return Sealed(found["code"], done.stdout + done.stderr, tuple(found["sent"]))


def _destination(packet: bytes, protocol: int) -> str | None:
    """Where an IP packet was to go, with the name that it asks for; None if that is this machine."""
    if protocol == _IPV4:
        address: ipaddress.IPv4Address | ipaddress.IPv6Address = ipaddress.IPv4Address(packet[16:20])
        kind, payload = packet[9], packet[4 * (packet[0] & 15) :]
    elif protocol == _IPV6:
        address, kind, payload = ipaddress.IPv6Address(packet[24:40]), packet[6], packet[40:]
    else:
        return None
    if kind not in (_TCP, _UDP):
        return None
    port = int.from_bytes(payload[2:4], "big")
    if kind == _UDP and port == _NAMES:
        return f"look-up of {payload[20:80]!r}"
    return None if address.is_loopback else f"{address} port {port}"


def _listen(found: list[str]) -> None:
    tap = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(_ALL_PROTOCOLS))
    tap.bind(("lo", _ALL_PROTOCOLS))

    def record() -> None:
        while True:
            packet, (_, protocol, direction, *_) = tap.recvfrom(2**16)
            where = _destination(packet, protocol)
            if direction == _OUTGOING and where is not None and where not in found:
                found.append(where)

    threading.Thread(target=record, daemon=True).start()


def _main(record: str, seconds: str, after: str, *command: str) -> None:
    for line in _SETUP:
        subprocess.run(line.split(), check="-6" not in line, capture_output=True)
    found: list[str] = []
    _listen(found)
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    has_said = threading.Event()

    def echo() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="")
            if after in line:
                has_said.set()
        has_said.set()

    reader = threading.Thread(target=echo)
    reader.start()
    if after:
        has_said.wait(PATIENCE)
    try:
        code = process.wait(float(seconds))
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
        code = process.wait(PATIENCE)
    reader.join()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:  # when this one has been seen, so have all before it
        end.sendto(b"", (_PROBE, _DISCARD))
    while (probe := f"{_PROBE} port {_DISCARD}") not in found:
        time.sleep(0.01)
    found.remove(probe)
    Path(record).write_text(json.dumps({"code": code, "sent": found}))


if __name__ == "__main__":
    _main(*sys.argv[1:])
