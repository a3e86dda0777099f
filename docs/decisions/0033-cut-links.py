"""Zenoh 1.10.2: links that are cut without a word make a router deaf for ten seconds.

As root, with iproute2 and `pip install eclipse-zenoh`:

    python 0033-cut-links.py 4            four subscribers on a host whose address is removed
    python 0033-cut-links.py 4 no-linger  the same, with SO_LINGER of the router's sockets cleared

Prints the longest time between two messages that a healthy client sends 50 times a second.
"""

from __future__ import annotations

import itertools
import json
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import zenoh

SUBSCRIBERS = """
import sys, threading, zenoh
text = '{mode: "client", connect: {endpoints: ["%s"]}, transport: {link: {tx: {lease: 2000}}}}'
kept = []
for _ in range(int(sys.argv[2])):
    session = zenoh.open(zenoh.Config.from_json5(text % sys.argv[1]))
    kept += [session, session.declare_subscriber("**", lambda sample: None)]
print("up", flush=True)
threading.Event().wait()
"""


def clear_linger() -> None:
    """Clear SO_LINGER of this process's TCP sockets."""
    for name in list(Path("/proc/self/fd").iterdir()):
        try:
            if str(name.readlink()).startswith("socket:"):
                with socket.socket(fileno=os.dup(int(name.name))) as ours:
                    off = struct.pack("ii", 0, 0)
                    ours.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, off)
        except OSError:
            pass


def main(links: int, linger: bool) -> None:
    """Run once."""
    name = f"zn{os.getpid()}"
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    for line in (
        f"ip netns add {name}",
        f"ip link add {name}a type veth peer name {name}b netns {name}",
        f"ip addr add 10.231.7.1/24 dev {name}a",
        f"ip link set {name}a up",
        f"ip -n {name} addr add 10.231.7.2/24 dev {name}b",
        f"ip -n {name} link set {name}b up",
    ):
        subprocess.run(line.split(), check=True)
    near, far = f"tcp/127.0.0.1:{port}", f"tcp/10.231.7.1:{port}"
    config = zenoh.Config()
    for key, value in {"mode": "router", "listen/endpoints": [near, far]}.items():
        config.insert_json5(key, json.dumps(value))
    router = zenoh.open(config)
    inside = ["ip", "netns", "exec", name, sys.executable, "-c", SUBSCRIBERS, far, str(links)]
    hung = subprocess.Popen(inside, stdout=subprocess.PIPE)
    try:
        assert hung.stdout is not None
        hung.stdout.readline()
        arrivals: list[float] = []
        kept = router.declare_subscriber("sample", lambda _: arrivals.append(time.monotonic()))
        client = zenoh.open(
            zenoh.Config.from_json5(f'{{mode: "client", connect: {{endpoints: ["{near}"]}}}}')
        )
        publisher, tick = client.declare_publisher("sample"), threading.Event()
        subprocess.run(["ip", "-n", name, "addr", "flush", "dev", f"{name}b"], check=True)
        for k in range(1000):
            publisher.put(b"x" * 500)
            if not linger and k % 10 == 0:
                clear_linger()
            tick.wait(0.02)
        gaps = [b - a for a, b in itertools.pairwise(arrivals)]
        print(f"{links} links cut: longest gap {max(gaps):.3f} s, {len(arrivals)} of 1000 arrived")
        del kept
    finally:
        hung.kill()
        hung.wait()
        for line in (f"ip netns del {name}", f"ip link del {name}a"):
            subprocess.run(line.split(), check=True)
        os._exit(0)  # closing the sessions would wait for the same sockets


if __name__ == "__main__":
    main(int(sys.argv[1]), "no-linger" not in sys.argv)
