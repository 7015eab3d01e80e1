"""A policy server in a thread, and a client written only from the protocol."""

from __future__ import annotations

import asyncio
import queue
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import msgpack
import numpy as np
from websockets.sync.client import connect

from aegis_cli.deploy import DeployedPolicy
from aegis_cli.serving.server import Serving, listen
from samples.training import make_policy

TEXT = "go to the red target"


def deployed(policy: Any = None, cameras: tuple[str, ...] = (), seed: int = 0) -> DeployedPolicy:
    """The tiny policy with three positions and two actions."""
    own = make_policy().eval() if policy is None else policy
    return DeployedPolicy(own, "reach", cameras, replan=2, seed=seed)


def observation(seed: int = 0, **changes: Any) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    keys = {
        "observation/image": rng.integers(0, 256, (64, 64, 3), np.uint8),
        "observation/state": rng.normal(size=3),
        "prompt": TEXT,
    }
    return keys | changes


@contextmanager
def served(
    policy: DeployedPolicy, prompt: str | None = None, tell: Callable[[str], object] = id
) -> Iterator[Serving]:
    """The policy at a free port of this machine, until the block ends."""
    ready: queue.Queue[Serving] = queue.Queue()
    ends = threading.Event()
    raised: list[BaseException] = []

    def work() -> None:
        try:
            asyncio.run(listen(policy, "127.0.0.1", 0, prompt, ready.put, ends.is_set, tell))
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield ready.get(timeout=30)
    finally:
        ends.set()
        thread.join(timeout=30)
    assert not thread.is_alive() and raised == []


class Client:
    """What openpi's client sends and reads, with its own packing."""

    def __init__(self, url: str) -> None:
        self.url = url

    def say(self, message: str | bytes) -> Any:
        """The answer to a raw message; an error is a text."""
        self.socket.send(message)
        answer = self.socket.recv(timeout=20)
        return answer if isinstance(answer, str) else unpack(answer)

    def infer(self, seen: Any) -> Any:
        return self.say(msgpack.packb(seen, default=_packed))

    def __enter__(self) -> Client:
        with ExitStack() as stack:
            connection = connect(self.url, compression=None, max_size=None)
            self.socket = stack.enter_context(connection)
            self.metadata = unpack(self.socket.recv(timeout=20))
            self.stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self.stack.close()


def _packed(value: Any) -> Any:
    assert isinstance(value, np.ndarray)
    about = {b"dtype": value.dtype.str, b"shape": value.shape}
    return {b"__ndarray__": True, b"data": value.tobytes(), **about}


def unpack(data: bytes) -> Any:
    def hook(found: dict[Any, Any]) -> Any:
        if b"__ndarray__" not in found:
            return found
        return np.ndarray(found[b"shape"], np.dtype(found[b"dtype"]), found[b"data"])

    return msgpack.unpackb(data, object_hook=hook)
