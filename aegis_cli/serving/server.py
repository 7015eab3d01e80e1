"""`aegis serve`: a policy behind openpi's websocket protocol.

A client gets metadata when it connects. Then each binary message is an observation, and each answer
is an action chunk, or a text with an error. `/healthz` answers plain HTTP. The protocol is that of
openpi's `websocket_policy_server` (https://github.com/Physical-Intelligence/openpi).
"""

from __future__ import annotations

import asyncio
import contextlib
import http
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from aegis_cli.common import interrupts
from aegis_cli.common.errors import AegisError
from aegis_cli.deploy import DeployedPolicy, load_policy
from aegis_cli.serving import wire
from aegis_cli.serving.observations import PREVIOUS, Observation, Reader

HEALTH = "/healthz"
LARGEST_MESSAGE = 256 * 2**20  # bytes; several uncompressed camera pictures are a tenth of this
_LOOK_S = 0.2  # interval at which the server checks whether to stop
Tell = Callable[[str], object]


def _silently(_: str) -> None:
    """The default for `tell`: ignore all messages."""


@dataclass(frozen=True)
class Serving:
    """The address of a listening server, and the metadata that it sends to clients."""

    url: str
    health: str
    metadata: dict[str, Any]


def run(
    run_path: Path,
    task: str | None,
    host: str,
    port: int,
    prompt: str | None,
    seed: int,
    precision: str,
    on_ready: Callable[[Serving], None],
    ensemble: float | None = None,
    tell: Tell = _silently,
    backbone: str | None = None,
) -> None:
    """Serve a run's policy until a signal ends the process.

    Args:
        task: which policy, if the run is a stream of robot tasks.
        port: 0 takes a free one.
        prompt: the instruction for observations without one.
        seed: seed of the noise, the same for every connection.
        precision, ensemble, backbone: see `load_policy`.
        on_ready: called with the address once the server listens.
        tell: called with a line about what is loaded, who connects, what is refused, positions far
            from those of the training, and who disconnects.

    Raises:
        AegisError: there is no such run, the address cannot be bound, or the policy cannot read the
            prompt.
        KeyboardInterrupt: a signal was received, and the connections are closed.
    """
    if not host.strip():  # it would listen on all addresses
        raise AegisError("an empty --host", "an address of this machine", "--host 127.0.0.1")
    if prompt is not None and not prompt.strip():
        raise AegisError("an empty --prompt", "an instruction", "leave --prompt out")
    tell(f"loading '{run_path}'")  # a large VLM takes a minute or more
    policy = load_policy(run_path, task, seed, precision, ensemble=ensemble, backbone=backbone)
    if prompt is not None:
        policy.check_instruction(prompt)
    with interrupts.deferred() as signaled:

        def ends() -> bool:
            return signaled.number is not None  # noted, not raised: connections close properly

        asyncio.run(listen(policy, host, port, prompt, on_ready, ends, tell))


async def listen(
    policy: DeployedPolicy,
    host: str,
    port: int,
    prompt: str | None,
    on_ready: Callable[[Serving], None],
    ends: Callable[[], bool],
    tell: Tell = _silently,
) -> None:
    """Serve a loaded policy until `ends()` is True; then close the connections."""
    answering = _Answering(policy, prompt, tell)
    try:
        server = await serve(
            answering.handle,
            host,
            port,
            compression=None,  # pictures hardly compress, and the robot waits
            max_size=LARGEST_MESSAGE,
            process_request=_health,
        )
    except (OSError, OverflowError) as error:
        raise AegisError(
            f"cannot listen at {host}:{port}: {getattr(error, 'strerror', None) or error}",
            "an address of this machine with a free port",
            "choose another --port; --port 0 takes a free one",
        ) from error
    async with server:
        on_ready(_where(server, answering.reader))
        while not ends():
            await asyncio.sleep(_LOOK_S)


def _where(server: Server, reader: Reader) -> Serving:
    # The actual address: for port 0 the system has chosen a port.
    host, port = next(iter(server.sockets)).getsockname()[:2]
    address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
    return Serving(f"ws://{address}", f"http://{address}{HEALTH}", reader.greeting())


def _health(connection: ServerConnection, request: Request) -> Response | None:
    """The answer to a health check; None lets the connection become a websocket."""
    if request.path.partition("?")[0] == HEALTH:
        return connection.respond(http.HTTPStatus.OK, "OK\n")
    return None


class _Visit:
    """Reports on one connection."""

    def __init__(self, connection: ServerConnection, tell: Tell) -> None:
        address = connection.remote_address  # None if the client is already gone
        self._name = "a client" if address is None else f"{address[0]}:{address[1]}"
        self._tell = tell
        self._chunks, self._seconds, self._refused = 0, 0.0, ""
        tell(f"{self._name} has connected")

    def answered(self, seconds: float) -> None:
        """A chunk was sent `seconds` after its observation arrived."""
        self._chunks, self._seconds, self._refused = self._chunks + 1, self._seconds + seconds, ""

    def refused(self, error: AegisError) -> None:
        """Report an error once: a robot that keeps asking causes the same one at every step."""
        if str(error) != self._refused:
            self._refused = str(error)
            self._tell(f"{self._name} was refused: {'; '.join(self._refused.splitlines())}")

    def sent(self, what: str) -> None:
        """Report what was unusual about an observation that is answered nevertheless."""
        self._tell(f"{self._name} sent {what}")

    def ended(self) -> None:
        """Report how many chunks the client was sent, and the mean time of each."""
        each = f", {1000 * self._seconds / self._chunks:.0f} ms each" if self._chunks else ""
        chunks = "1 chunk" if self._chunks == 1 else f"{self._chunks:,} chunks"
        self._tell(f"{self._name} has gone after {chunks}{each}")


class _Answering:
    """Answers all connections; each has its own policy object, which shares the weights.

    One chunk is predicted at a time: two at once would each take twice as long.
    """

    def __init__(self, policy: DeployedPolicy, prompt: str | None, tell: Tell) -> None:
        self._policy, self.reader = policy, Reader(policy, prompt)
        self._turn, self._tell = asyncio.Lock(), tell

    async def handle(self, connection: ServerConnection) -> None:
        """Greet, then answer until the client disconnects."""
        visit = _Visit(connection, self._tell)
        try:
            with contextlib.suppress(ConnectionClosed):
                await connection.send(wire.encode(self.reader.greeting()))
                await self._converse(connection, self._policy.begin(visit.sent), visit)
        finally:
            visit.ended()

    async def _converse(
        self, connection: ServerConnection, policy: DeployedPolicy, visit: _Visit
    ) -> None:
        previous_s: float | None = None
        async for message in connection:  # until the client closes it
            started = time.perf_counter()
            try:
                answer = await self._answer(policy, message)
            except AegisError as error:  # the client's mistake; it may continue
                visit.refused(error)
                await connection.send(str(error))
                continue
            except Exception as error:
                await connection.send(f"{type(error).__name__}: {error}")
                raise  # websockets logs it and closes only this connection
            if previous_s is not None:
                answer["server_timing"]["prev_total_ms"] = 1000 * previous_s
            await connection.send(wire.encode(answer))
            previous_s = time.perf_counter() - started
            visit.answered(previous_s)

    async def _answer(self, policy: DeployedPolicy, message: str | bytes) -> dict[str, Any]:
        """Actions [H, A] for an observation, with the milliseconds that they took.

        With a temporal ensemble they are [1, A], since each observation is the connection's next
        step.

        Raises:
            AegisError: the message is no observation for this policy.
        """
        if isinstance(message, str):
            fix = "send it with openpi_client.websocket_client_policy"
            raise AegisError("a text message", "an observation in msgpack, as bytes", fix)
        # Read before taking the lock: a bad message need not wait.
        seen = self.reader.read(wire.decode(message))
        async with self._turn:
            started = time.perf_counter()
            # In a thread, so that health checks and pings are answered meanwhile.
            actions = await asyncio.to_thread(_actions, policy, seen)
            infer_ms = 1000 * (time.perf_counter() - started)
        return {
            "actions": actions,
            "policy_timing": {"infer_ms": infer_ms},
            "server_timing": {"infer_ms": infer_ms},
        }


def _actions(policy: DeployedPolicy, seen: Observation) -> np.ndarray:
    """The policy's chunk [H, A]; with a temporal ensemble the one action [1, A] of this step."""
    given = (seen.pictures, seen.prompt, seen.state)
    if policy.ensemble is None:
        return policy.predict_action_chunk(*given, seen.previous, seen.delay)
    if seen.previous is not None:
        raise AegisError(
            f"'{PREVIOUS}' for a temporal ensemble, which executes one action of each chunk",
            "observations without it",
            "serve the policy without --ensemble",
        )
    return policy.select_action(*given)[None]
