"""Spawned processes that make items; if one dies, only its item is lost, and is tried once more."""

import multiprocessing
import os
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path

from .plan import ItemKey
from .settings import Settings

CRASH_VARIABLE = "COW_SCENES_CRASH"
"""Test hook: the id of an item at which the process that makes it dies."""


@dataclass(frozen=True)
class Made:
    """An item is there."""

    key: ItemKey


@dataclass(frozen=True)
class Failed:
    """An item could not be made, twice."""

    key: ItemKey
    reason: str


@dataclass
class Worker:
    """One process, our end of its pipe and the item it is at."""

    process: multiprocessing.process.BaseProcess
    pipe: Connection
    key: ItemKey | None = None


def leave_with_parent() -> None:
    """End this process when the one that started it is gone, so that a killed run leaves nothing behind."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def serve(pipe: Connection, out: Path, settings: Settings, threads: int) -> None:
    """Make the items that come through the pipe, until it closes."""
    # Blender writes a line per picture to standard output, below Python.
    quiet = os.open(os.devnull, os.O_WRONLY)
    os.dup2(quiet, 1)
    os.dup2(quiet, 2)
    threading.Thread(target=leave_with_parent, daemon=True).start()
    from .item import make_item  # noqa: PLC0415

    while True:
        try:
            key = pipe.recv()
        except (EOFError, KeyboardInterrupt):
            return
        if os.environ.get(CRASH_VARIABLE) == key.id:
            os._exit(3)
        try:
            make_item(out, key, settings, threads)
        except Exception as error:  # noqa: BLE001 - any error of an item is reported, and the process goes on
            pipe.send(f"{type(error).__name__}: {error}")
        else:
            pipe.send(None)


def start(out: Path, settings: Settings, threads: int) -> Worker:
    """A new process. Spawned, because neither Blender nor Bullet may be forked."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=serve, args=(theirs, out, settings, threads), daemon=True)
    process.start()
    theirs.close()
    return Worker(process, ours)


def outcome(worker: Worker) -> str | None:
    """None if the worker made its item, else why not."""
    try:
        return worker.pipe.recv()
    except EOFError:
        worker.process.join()
        return f"its process ended with code {worker.process.exitcode}"


def make_all(keys: tuple[ItemKey, ...], out: Path, settings: Settings, processes: int) -> Iterator[Made | Failed]:
    """Make items in `processes` processes; what is done is yielded as it comes."""
    threads = max(1, (os.cpu_count() or 1) // processes)
    waiting, tried, idle = deque(keys), set(), []
    workers = [start(out, settings, threads) for _ in range(min(processes, len(keys)))]
    idle.extend(workers)
    busy: list[Worker] = []
    try:
        while waiting or busy:
            while waiting and idle:
                worker = idle.pop()
                worker.key = waiting.popleft()
                worker.pipe.send(worker.key)
                busy.append(worker)
            ready = wait([w.pipe for w in busy])
            for worker in [w for w in busy if w.pipe in ready]:
                busy.remove(worker)
                key, reason = worker.key, outcome(worker)
                idle.append(worker if worker.process.is_alive() else start(out, settings, threads))
                assert key is not None
                if reason is None:
                    yield Made(key)
                elif key in tried:
                    yield Failed(key, reason)
                else:
                    tried.add(key)
                    waiting.append(key)
    finally:
        for worker in [*idle, *busy]:
            worker.pipe.close()
            worker.process.terminate()
