"""The bridge between a server and its actors in a Ray cluster, and the actors.

The bridge is a process of its own that is connected to the cluster. It passes messages on, unread: what actors send is
unpickled here, as Ray does it, and not in the server.
"""

import json
import logging
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any

from pydantic_core import to_json

from cow_service.concurrency import leave_decisions_to_the_parent

MODULE = "cow_service.workers.ray_bridge"
NODES_SECONDS = 0.5  # between two reports on the nodes


def pack(kind: str, number: int = 0, data: bytes = b"") -> bytes:
    """What server and bridge tell each other: about which actor, if any, and what."""
    return f"{kind} {number} ".encode() + data


def unpack(frame: bytes) -> tuple[str, int, bytes]:
    """The kind, the number of the actor, and the data of what `pack` made."""
    kind, number, data = frame.split(b" ", 2)
    return kind.decode(), int(number), data


class Actor:
    """A worker, in a process of the cluster: its pipe is made of calls and what they yield."""

    def __init__(self) -> None:
        self._inward, self._outward = SimpleQueue[bytes](), SimpleQueue[bytes]()
        self.send_bytes = self._outward.put

    def recv_bytes(self, maxlength: int | None = None, /) -> bytes:
        """The next message of the server."""
        return self._inward.get()

    def tell(self, message: bytes) -> None:
        """Takes a message of the server."""
        self._inward.put(message)

    def messages(self) -> Iterator[bytes]:
        """The process, then what it has to say, to its end."""
        from cow_service.workers.child import work  # noqa: PLC0415 # takes long to import

        def run() -> None:
            work(self)
            self._outward.put(b"")

        yield str(os.getpid()).encode()
        threading.Thread(target=run, name="work", daemon=True).start()
        while message := self._outward.get():
            yield message


def main(descriptor: int) -> None:
    """The bridge: connects to the cluster, and passes on what comes, until either end is gone."""
    import ray  # noqa: PLC0415 # only where it is used
    from ray.exceptions import ActorUnavailableError, RayError  # noqa: PLC0415

    leave_decisions_to_the_parent()
    pipe, sending, actors = Connection(descriptor), threading.Lock(), dict[int, Any]()

    def send(kind: str, number: int = 0, data: bytes = b"") -> None:
        with sending, suppress(OSError):  # its end is noticed where its messages are read
            pipe.send_bytes(pack(kind, number, data))

    def follow(number: int, actor: Any) -> None:
        kind, end, how = "placed", "end", "ended"
        try:
            for reference in actor.messages.options(num_returns="streaming").remote():
                send(kind, number, ray.get(reference))
                kind = "message"
        except RayError as error:  # its node ended, or cannot be reached, where nobody knows what became of it
            end, how = "lost" if isinstance(error, ActorUnavailableError) else "end", f"{type(error).__name__}\n{error}"
        del actors[number]
        send(end, number, how.encode())
        with suppress(RayError):
            ray.kill(actor)

    def tell_nodes() -> None:
        own = ray.get_runtime_context().get_node_id()
        while True:
            alive = {node["NodeID"]: node for node in ray.nodes() if node["Alive"]}
            if own not in alive:
                send("fault", 0, b"its node on this machine ended")
                os._exit(1)
            send("nodes", 0, to_json([(one["NodeManagerHostname"], one["Resources"]) for one in alive.values()]))
            time.sleep(NODES_SECONDS)

    try:
        ray.init(pipe.recv_bytes().decode(), namespace="cow", log_to_driver=False, logging_level=logging.ERROR)
    except (OSError, RuntimeError, ValueError) as error:
        send("fault", 0, str(error).partition("\n")[0].rstrip(".").encode())
        return
    threading.Thread(target=tell_nodes, name="nodes", daemon=True).start()
    groups: Any = {"concurrency_groups": {"tell": 1}}  # whose single thread keeps messages in order
    make = ray.remote(**groups)(Actor)
    with suppress(EOFError, OSError):
        while True:
            kind, number, data = unpack(pipe.recv_bytes())
            with suppress(RayError):  # of one actor: whoever follows it hears of it
                if kind == "start":
                    options = json.loads(data) | {"scheduling_strategy": "SPREAD"}
                    actors[number] = make.options(**options).remote()
                    threading.Thread(target=follow, args=(number, actors[number]), daemon=True).start()
                elif (actor := actors.get(number)) is not None and kind == "message":
                    actor.tell.options(concurrency_group="tell").remote(data)
                elif actor is not None:
                    ray.kill(actor)
    ray.shutdown()
    os._exit(0)  # threads may wait for actors


if __name__ == "__main__":
    import_module(MODULE).main(int(sys.argv[1]))  # the classes of `__main__` would travel as code
