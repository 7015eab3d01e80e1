"""Clients of the policy server get the policy's own actions, and a clear error if they err."""

from __future__ import annotations

import asyncio
import json
import re
import signal
import socket
import threading
import time
import urllib.request
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from samples import processes
from samples.command import refused
from samples.serving import TEXT, Client, deployed, observation, served
from samples.training import make_policy
from websockets.exceptions import ConnectionClosed

from aegis_cli import load_policy
from aegis_cli.common.errors import AegisError
from aegis_cli.deploy import DeployedPolicy
from aegis_cli.serving import server
from aegis_cli.serving.server import Serving, listen


def chunk(policy: Any, seen: dict[str, Any]) -> np.ndarray:
    """The policy's prediction without a server."""
    arguments = (seen["observation/image"], seen["prompt"], seen["observation/state"])
    return policy.predict_action_chunk(*arguments)


def test_a_client_gets_the_policys_own_actions() -> None:
    own = deployed()
    with served(deployed()) as serving, Client(serving.url) as client:
        for seed in range(3):
            seen = observation(seed)
            answer = client.infer(seen)
            np.testing.assert_array_equal(answer["actions"], chunk(own, seen))
            assert answer["actions"].dtype == np.float32 and answer["actions"].shape == (4, 2)
            assert answer["policy_timing"]["infer_ms"] > 0
            timing = answer["server_timing"]
            assert timing["infer_ms"] > 0 and ("prev_total_ms" in timing) == (seed > 0)


# The stock client opens its connection as older releases of websockets had it.
@pytest.mark.filterwarnings("ignore:connect:DeprecationWarning")
def test_the_stock_client_of_openpi_gets_the_actions_of_load_policy(naive_run: Path) -> None:
    openpi = pytest.importorskip("openpi_client.websocket_client_policy")
    own = load_policy(naive_run, seed=3)
    with served(load_policy(naive_run, seed=3)) as serving:
        host, port = serving.url.removeprefix("ws://").split(":")
        client = openpi.WebsocketClientPolicy(host, int(port))
        assert client.get_server_metadata() == serving.metadata
        for seed in range(2):
            seen = observation(seed, **{"observation/state": np.full(6, 0.1)})
            found = client.infer(seen)
            np.testing.assert_array_equal(found["actions"], chunk(own, seen))
        with pytest.raises(RuntimeError, match="no instruction in an observation"):
            client.infer({key: value for key, value in seen.items() if key != "prompt"})
        np.testing.assert_array_equal(client.infer(seen)["actions"], chunk(own, seen))
        broker = pytest.importorskip("openpi_client.action_chunk_broker")
        one_by_one = broker.ActionChunkBroker(client, action_horizon=2)
        whole = chunk(own, seen)
        for action in whole[:2]:
            np.testing.assert_array_equal(one_by_one.infer(seen)["actions"], action)
        client._ws.close()


def test_every_connection_is_an_episode_of_its_own() -> None:
    seen = observation()
    with served(deployed()) as serving:
        with Client(serving.url) as one, Client(serving.url) as other:
            first = one.infer(seen)["actions"]
            second = one.infer(seen)["actions"]
            np.testing.assert_array_equal(other.infer(seen)["actions"], first)
            assert not np.array_equal(first, second)  # the noise continues
        with Client(serving.url) as third:
            np.testing.assert_array_equal(third.infer(seen)["actions"], first)


def test_the_greeting_says_what_to_send() -> None:
    with served(deployed(), "touch the blue ball") as serving, Client(serving.url) as client:
        assert client.metadata == serving.metadata
        sizes = {"positions": 3, "actions": 2, "chunk": 4, "replan": 2}
        assert sizes.items() <= client.metadata.items()
        assert client.metadata["images"] == ["observation/image"]
        assert client.metadata["default_prompt"] == "touch the blue ball"


def test_an_observation_without_a_prompt_has_the_servers() -> None:
    seen = observation()
    without = {key: value for key, value in seen.items() if key != "prompt"}
    with served(deployed(), TEXT) as serving, Client(serving.url) as client:
        np.testing.assert_array_equal(client.infer(without)["actions"], chunk(deployed(), seen))


def test_a_robot_that_moves_meanwhile_gets_a_chunk_that_continues_its_own() -> None:
    own, seen = deployed(), observation()
    given = (seen["observation/image"], seen["prompt"], seen["observation/state"])
    previous = np.linspace(-1, 1, 6, dtype=np.float32).reshape(3, 2)
    with served(deployed()) as serving, Client(serving.url) as client:
        names = client.metadata["previous"], client.metadata["delay"]
        for left, delay in ((previous, 2), (previous, 0), (previous[:0], 0)):
            answer = client.infer({**seen, **dict(zip(names, (left, delay), strict=True))})
            expected = own.predict_action_chunk(*given, left, delay)
            np.testing.assert_array_equal(answer["actions"], expected)
        for wrong, said in (
            ((previous, 4), "a delay of 4 actions"),
            ((previous[:, :1], 0), "previous actions of shape (3, 1)"),
            (("none", 0), "'previous_actions' of type"),
            ((None, 1), "a delay of 1 actions, and no previous actions"),
        ):
            refused = client.infer({**seen, **dict(zip(names, wrong, strict=True))})
            assert isinstance(refused, str) and said in refused


# --- what goes wrong ------------------------------------------------------------------------------


def array(**changes: Any) -> bytes:
    """An observation whose state is a marked mapping of these parts."""
    marked = {b"__ndarray__": True, b"data": bytes(24), b"dtype": "<f8", b"shape": [3]}
    marked |= {name.encode(): value for name, value in changes.items()}
    return msgpack.packb({"observation/state": marked})


@pytest.mark.parametrize(
    ("message", "says"),
    [
        (b"", "cannot be read"),
        (b"\xc1", "cannot be read"),
        (b"\x81" * 2000, "cannot be read"),
        (msgpack.packb({"a": 1}) + b"more", "cannot be read"),
        (array(dtype="|O"), "array of type |O"),
        (array(dtype="nonsense"), "cannot be read"),
        (array(shape=[4]), "cannot be read"),
        (array(shape=[-2]), "cannot be read"),
        (array(data=None), "cannot be read"),
        (msgpack.packb({b"__ndarray__": True}), "no b'data'"),
        (msgpack.packb([1, 2]), "a message that is list"),
        (msgpack.packb({}), "an observation with nothing"),
        ("hello", "a text message"),
    ],
)
def test_a_message_that_is_no_observation_gets_an_error_and_ends_nothing(
    message: str | bytes, says: str, listening: Serving
) -> None:
    with Client(listening.url) as client:
        answer = client.say(message)
        assert isinstance(answer, str) and says in answer
        assert [line.split(":")[0] for line in answer.splitlines()] == ["found", "expected", "fix"]
        assert client.infer(observation())["actions"].shape == (4, 2)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"observation/state": np.zeros(4)}, "positions of shape (4,)"),
        ({"observation/state": np.zeros((1, 3))}, "positions of shape (1, 3)"),
        ({"observation/state": np.full(3, np.nan)}, "'observation/state' with nan"),
        ({"observation/state": ["a", "b", "c"]}, "which is not a number type"),
        ({"observation/state": [[1], [1, 2]]}, "not an array"),
        ({"observation/image": np.zeros((3, 64, 64), np.uint8)}, "shape (3, 64, 64)"),
        ({"observation/image": np.zeros((64, 64, 3))}, "type float64"),
        ({"observation/image": np.zeros((0, 64, 3), np.uint8)}, "shape (0, 64, 3)"),
        ({"observation/image": np.zeros((64, 0, 3), np.uint8)}, "shape (64, 0, 3)"),
        ({"observation/image": "picture"}, "shape ()"),
        ({"prompt": 5}, "'prompt' is int"),
        ({"prompt": "go to the xylophone"}, "'xylophone'"),
    ],
)
def test_an_observation_that_does_not_fit_says_why(
    changes: dict[str, Any], says: str, listening: Serving
) -> None:
    with Client(listening.url) as client:
        answer = client.infer(observation(**changes))
        assert isinstance(answer, str) and says in answer
        lists = {"observation/state": [0.5, 0.0, 1.0], "something/else": 1}
        assert client.infer(observation(**lists))["actions"].shape == (4, 2)


def test_the_server_tells_who_comes_what_is_refused_and_who_goes() -> None:
    told: list[str] = []
    with served(deployed(), tell=told.append) as serving, Client(serving.url) as client:
        for _ in range(3):  # a robot that keeps asking
            client.infer(observation(prompt=""))
        client.infer(observation())
        client.infer(observation(prompt=""))
    (name,) = {line.split(" ")[0] for line in told}
    assert name.startswith("127.0.0.1:")
    said = [line.removeprefix(f"{name} ") for line in told]
    assert said[0] == "has connected"
    assert len(said) == 4 and all(
        line.startswith("was refused: found: a blank 'prompt'") for line in said[1:3]
    )
    assert re.fullmatch(r"has gone after 1 chunk, \d+ ms each", said[3])


def test_positions_in_other_units_are_answered_and_told_of_once_per_connection() -> None:
    told: list[str] = []
    far = observation(**{"observation/state": [-2000.0, 0.0, 0.0]})
    with served(deployed(), tell=told.append) as serving:
        for _ in range(2):
            with Client(serving.url) as client:
                answers = [client.infer(far) for _ in range(3)]
            assert all(answer["actions"].shape == (4, 2) for answer in answers)
    said = [line.partition(" ")[2] for line in told]
    sent = [line for line in said if line.startswith("sent positions far from those of the train")]
    assert len(sent) == 2 and len(said) == 6 and said[1] == said[4] == sent[0]
    assert "positions[0] is -2000 (training mean 0.1, standard deviation 1.5)" in sent[0]
    assert "\n" not in sent[0]


@pytest.fixture(scope="module")
def listening() -> Any:
    with served(deployed()) as serving:
        yield serving


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_defect_ends_its_own_connection_alone() -> None:
    class Broken:
        """A policy that cannot act."""

        def __init__(self) -> None:
            vars(self).update(vars(make_policy().eval()))
            self.proprio_scale, self.action_scale = (
                make_policy().proprio_scale,
                make_policy().action_scale,
            )
            self.backbone, self.expert = make_policy().backbone, make_policy().expert

        def act(self, *_: object) -> None:
            raise RuntimeError("out of ideas")

    with served(deployed(Broken())) as serving:
        with Client(serving.url) as client:
            assert client.infer(observation()) == "RuntimeError: out of ideas"
            with pytest.raises(ConnectionClosed):
                client.infer(observation())
        assert asked(serving.health) == "OK\n"
        with Client(serving.url) as client:
            assert client.metadata == serving.metadata


def asked(address: str) -> str:
    with urllib.request.urlopen(address, timeout=10) as answer:
        return answer.read().decode()


def test_health_is_answered_while_a_chunk_is_predicted() -> None:
    begun, go_on = threading.Event(), threading.Event()
    policy = make_policy().eval()
    act = policy.act

    def slow(*arguments: Any) -> Any:
        begun.set()
        assert go_on.wait(10)
        return act(*arguments)

    policy.act = slow  # type: ignore[method-assign]
    found: list[Any] = []
    with served(deployed(policy)) as serving, Client(serving.url) as client:
        thread = threading.Thread(target=lambda: found.append(client.infer(observation())))
        thread.start()
        assert begun.wait(10)
        assert asked(serving.health) == "OK\n"
        go_on.set()
        thread.join(10)
    assert found[0]["actions"].shape == (4, 2)


def test_a_port_that_is_taken_is_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(AegisError, match=f"cannot listen at 127.0.0.1:{port}"):
            asyncio.run(listen(deployed(), "127.0.0.1", port, None, print, lambda: True))


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (("--prompt", "pick up the cup"), "'pick'"),
        (("--prompt", " "), "an empty --prompt"),
        (("--host", ""), "an empty --host"),
    ],
)
def test_what_would_answer_nobody_or_everybody_is_refused_before_it_listens(
    options: tuple[str, ...], problem: str, aegis: Any, naive_run: Path
) -> None:
    assert problem in refused(aegis("serve", naive_run, "--port", 0, *options))


@pytest.mark.parametrize("precision", ["auto", "bf16", "float32"])
def test_the_policy_acts_in_the_precision_that_was_asked_for(
    precision: str, aegis: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def loaded(*given: Any, **_: Any) -> None:
        raise AegisError(f"loaded in {given[-1]}", "nothing", "no more")

    monkeypatch.setattr(server, "load_policy", loaded)
    words = () if precision == "auto" else ("--precision", precision)
    assert f"loaded in {precision}" in refused(aegis("serve", "run", *words))


def test_a_temporal_ensemble_answers_with_the_one_action_of_a_step() -> None:
    """Each connection has its own; a client that executes whole chunks executes this one."""
    decay = 0.1
    own, given = (
        DeployedPolicy(make_policy().eval(), "reach", (), replan=2, ensemble=decay)
        for _ in range(2)
    )
    plain = deployed()
    with served(given) as serving:
        metadata = serving.metadata
        assert [metadata[key] for key in ("chunk", "replan", "ensemble")] == [1, 1, decay]
        assert (metadata["previous"], metadata["delay"]) == (None, None)
        with Client(serving.url) as client:
            refused = client.infer(observation() | {"previous_actions": np.zeros((1, 2))})
            assert "'previous_actions' for a temporal ensemble" in refused
        for _ in range(2):
            own.reset()
            with Client(serving.url) as client:
                found = [client.infer(observation(seed))["actions"] for seed in range(5)]
            for seed, actions in enumerate(found):
                seen = observation(seed)
                shown = (seen["observation/image"], seen["prompt"], seen["observation/state"])
                np.testing.assert_array_equal(actions, own.select_action(*shown)[None])
    np.testing.assert_array_equal(found[0][0], chunk(plain, observation(0))[0])
    assert not np.allclose(found[1][0], chunk(plain, observation(1))[0])


def test_the_decay_that_was_asked_for_is_the_policys(
    aegis: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def loaded(*_: Any, ensemble: float | None, backbone: str | None) -> None:
        raise AegisError(f"with {ensemble}", "nothing", "no more")

    monkeypatch.setattr(server, "load_policy", loaded)
    for words, told in (((), None), (("--ensemble", "0.01"), 0.01), (("--ensemble=-0.5",), -0.5)):
        assert f"with {told}" in refused(aegis("serve", "run", *words))


def test_it_listens_at_loopback_and_ends_at_a_signal(naive_run: Path, tmp_path: Path) -> None:
    told = tmp_path / "told.txt"
    command = ["serve", str(naive_run), "--port", "0", "--json"]
    with processes.aegis(command, tmp_path, told) as process:
        while "\n}\n" not in told.read_text():
            assert process.exitcode is None, told.read_text()
            time.sleep(0.02)
        loading, _, report = told.read_text().partition("\n")
        said = json.loads(report)
        assert loading == f"loading '{naive_run}'"
        assert said["url"].startswith("ws://127.0.0.1:") and asked(said["health"]) == "OK\n"
        with Client(said["url"]) as client:
            assert client.metadata == said["metadata"]
            process.terminate()
            with pytest.raises(ConnectionClosed):
                client.socket.recv()
        process.join(20)
        assert process.exitcode == 128 + signal.SIGTERM
    *visit, ended = told.read_text().partition("\n}\n")[2].splitlines()
    assert ended == "ended by SIGTERM; the server is closed"
    assert [line.split(" ", 1)[1] for line in visit] == [
        "has connected",
        "has gone after 0 chunks",
    ]
