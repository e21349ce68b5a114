"""A real Ray cluster on this machine: several nodes, each of which can be killed."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import psutil
import pytest
from conftest import ROOT
from servers import SLOW_GENERATOR, send

SMALL = ("--num-cpus=1", "--memory=1000000000", "--object-store-memory=80000000")
OWN_PORTS = ("--min-worker-port=0", "--max-worker-port=0", "--dashboard-agent-listen-port=0")


class RayNodes:
    """The nodes of a cluster, the first of which is its head; each has a core for actors. `with` ends them."""

    def __init__(self, folder: Path) -> None:
        """`folder`: of the server, whose journal the actors write, too."""
        if find_spec("ray") is None:
            pytest.skip("Ray is not installed: pip install 'cow-service[ray]'")
        with socket.create_server(("127.0.0.1", 0)) as probe:
            self.address = f"127.0.0.1:{probe.getsockname()[1]}"  # what COW_RAY is
        self.folder = folder
        own = {"PYTHONPATH": f"{ROOT}:{SLOW_GENERATOR}", "SLOW_JOURNAL": str(folder / "journal")}
        own["RAY_health_check_period_ms"] = "1000"  # a lost node is noticed after five of these
        self._environment = {**os.environ, **own}
        self._nodes: list[psutil.Popen] = []

    def __enter__(self) -> RayNodes:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    @property
    def newest(self) -> psutil.Popen:
        """The node that was added last."""
        return self._nodes[-1]

    def add(self) -> psutil.Popen:
        """Another node, which is not waited for."""
        command = [str(Path(sys.executable).with_name("ray")), "start", "--block", "--disable-usage-stats", *SMALL]
        command += [*OWN_PORTS, "--node-ip-address=127.0.0.1"]
        if self._nodes:
            command += [f"--address={self.address}"]
        else:
            command += ["--head", f"--port={self.address.rpartition(':')[2]}", "--include-dashboard=false"]
        with (self.folder / "nodes").open("ab") as log:
            node = psutil.Popen(command, env=self._environment, stdout=log, stderr=subprocess.STDOUT)
        self._nodes.append(node)
        return node

    def kill(self, node: psutil.Popen) -> None:
        """Ends a node as a loss of power would."""
        self._nodes.remove(node)
        processes = [*node.children(recursive=True), node]
        send(processes, signal.SIGKILL)
        psutil.wait_procs(processes)

    def end(self) -> None:
        """Kills all nodes. The next one that is added is the head of a new cluster at the same address."""
        for node in reversed(self._nodes.copy()):
            self.kill(node)

    def actors(self) -> set[int]:
        """The processes of the actors, on all nodes."""
        return {one.pid for node in self._nodes for one in node.children(recursive=True) if "Actor" in one.name()}

    def has(self, node: psutil.Popen, pid: int) -> bool:
        """Whether a process runs on a node."""
        return pid in [one.pid for one in node.children(recursive=True)]
