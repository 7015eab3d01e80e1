"""Messages to and from clients: the keys of an observation, and of the greeting.

The keys are openpi's. LeRobot's observations, and those from a robot's `get_observation()`, are
read as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from aegis_cli.common.errors import AegisError
from aegis_cli.common.version import __version__
from aegis_cli.data.lerobot import layout, observation
from aegis_cli.deploy import DeployedPolicy, Pictures

STATE, PROMPT, IMAGE = "observation/state", "prompt", "observation/image"
PREVIOUS, DELAY = "previous_actions", "delay"  # from a client that moves while it waits


@dataclass(frozen=True)
class Observation:
    """A policy's input: pictures, instruction, and positions [P] float32.

    Attributes:
        previous, delay: as in `DeployedPolicy.predict_action_chunk`.
    """

    pictures: Pictures
    prompt: str
    state: np.ndarray
    previous: np.ndarray | None = None
    delay: int = 0


class Reader:
    """Reads the observations for one policy.

    Args:
        prompt: the instruction for observations without one; None: each must have its own.
    """

    def __init__(self, policy: DeployedPolicy, prompt: str | None = None) -> None:
        self._policy, self._prompt = policy, prompt
        names = policy.cameras or ("image",)  # openpi's name for a single camera
        self.images = {_key(name): name for name in names}

    def greeting(self) -> dict[str, Any]:
        """The metadata that a client gets when it connects."""
        policy = self._policy
        return {
            "server": f"aegis {__version__}",
            "task": policy.task or policy.in_stream,
            "images": list(self.images),
            "state": STATE,
            "prompt": PROMPT,
            "default_prompt": self._prompt,
            "positions": policy.positions,
            "actions": policy.actions,
            # An ensemble averages chunks on the server, and returns one action at a time.
            "chunk": policy.chunk if policy.ensemble is None else 1,
            "replan": policy.replan,
            "ensemble": policy.ensemble,
            "previous": PREVIOUS if policy.ensemble is None else None,
            "delay": DELAY if policy.ensemble is None else None,
            "action_names": _listed(policy.action_names),
            "state_names": _listed(policy.state_names),
            "fps": policy.fps,
        }

    def read(self, message: Any) -> Observation:
        """The observation of a message; keys that the policy does not need are ignored.

        Raises:
            AegisError: a key is missing, or has an invalid value.
        """
        if not isinstance(message, Mapping):
            raise self._wrong(f"a message that is {type(message).__name__}")
        # A robot's own observation is read as a whole, and has no other keys.
        seen = self._seen({key: x for key, x in message.items() if key not in (PREVIOUS, DELAY)})
        previous = message.get(PREVIOUS)
        if previous is not None:
            previous = self._finite(f"'{PREVIOUS}'", self._array(PREVIOUS, previous))
        return replace(seen, previous=previous, delay=message.get(DELAY, 0))

    def _seen(self, message: Mapping[Any, Any]) -> Observation:
        """The pictures, the instruction and the positions of a message."""
        policy = self._policy
        # openpi's key takes precedence: a client of its protocol may send other keys too.
        if STATE not in message and observation.is_one(message, policy.state_names, policy.state):
            return self._lerobots(message)
        sent = _sent(message)
        if len(self.images) == 1 and IMAGE in message:  # whatever the name of the only camera
            message = {next(iter(self.images)): message[IMAGE], **message}  # its own key wins
        text = self._text(message)
        missing = [key for key in (*self.images, STATE) if key not in message]
        if missing:
            raise self._wrong(f"no '{missing[0]}' in an observation with {sent}")
        if text is None:
            raise _without_instruction(message, sent)
        named = {name: self._array(key, message[key]) for key, name in self.images.items()}
        pictures = named if len(named) > 1 else next(iter(named.values()))
        return Observation(pictures, text, self._positions(message[STATE]))

    def _lerobots(self, message: Mapping[Any, Any]) -> Observation:
        """The observation of a message with LeRobot's keys, or with the motors' names."""
        policy = self._policy
        robots = {key: value for key, value in message.items() if key != PROMPT}
        seen = observation.read(robots, policy.cameras, policy.state_names, policy.state)
        text = self._text(message) if seen.task is None else seen.task
        if text is None:
            raise _without_instruction(message, _sent(message))
        return Observation(seen.pictures, text, self._finite("positions", seen.positions))

    def _text(self, message: Mapping[Any, Any]) -> str | None:
        """The message's instruction, or the server's if it is missing or blank."""
        text = message.get(PROMPT)
        if text is not None and not isinstance(text, str):
            raise self._wrong(f"'{PROMPT}' is {type(text).__name__}")
        return text if text and text.strip() else self._prompt

    def _positions(self, state: Any) -> np.ndarray:
        return self._finite(f"'{STATE}'", self._array(STATE, state))

    def _finite(self, what: str, found: np.ndarray) -> np.ndarray:
        if found.dtype.kind not in "biuf":
            raise self._wrong(f"{what} of type {found.dtype}, which is not a number type")
        # For NaN a policy would return actions that are NaN.
        is_finite = np.isfinite(found)
        if not is_finite.all():
            raise AegisError(
                f"{what} with {found[~is_finite].flat[0]}",
                "finite numbers",
                "read the robot's state again before it is sent",
            )
        return found.astype(np.float32)

    def _array(self, key: str, value: Any) -> np.ndarray:
        """A value of a message as an array; clients may send lists of numbers."""
        try:
            return np.asarray(value)
        except ValueError as error:  # lists of several lengths
            raise self._wrong(f"'{key}' is not an array: {error}") from error

    def _wrong(self, found: str) -> AegisError:
        """The error for a message that is no observation, with the expected form."""
        images = ", ".join(f"'{key}': [H, W, 3] uint8" for key in self.images)
        expected = f"{{{images}, '{STATE}': [{self._policy.positions}], '{PROMPT}': text}}"
        return AegisError(found, expected, "name and shape them as the server's metadata says")


def _sent(message: Mapping[Any, Any]) -> str:
    return ", ".join(sorted(map(str, message))) or "nothing"


def _without_instruction(message: Mapping[Any, Any], sent: str) -> AegisError:
    blank = [key for key in (PROMPT, observation.TASK) if message.get(key) is not None]
    what = f"a blank '{blank[0]}'" if blank else "no instruction"
    return AegisError(
        f"{what} in an observation with {sent}",
        f"a text at '{PROMPT}', or with LeRobot's keys at '{observation.TASK}'",
        "send an instruction, or give aegis serve one by --prompt",
    )


def _key(camera: str) -> str:
    """A camera's key in an observation; a dataset's `observation.image` gets openpi's key."""
    return f"observation/{layout.short(camera).removeprefix('observation.')}"


def _listed(names: tuple[str, ...] | None) -> list[str] | None:
    """The names as a list, as a client unpacks them."""
    return None if names is None else list(names)
