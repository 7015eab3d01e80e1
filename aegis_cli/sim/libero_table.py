"""Names, suites and facts of LIBERO's tasks (arXiv 2306.03310); needs neither LIBERO nor MuJoCo."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

from aegis_cli.sim.contract import LIBERO, TaskSpec
from aegis_cli.sim.libero_instructions import INSTRUCTIONS

# The number of tasks in each suite, and the most steps in an episode: LeRobot's limits, within
# which the longest demonstration stays. openpi ends episodes of `spatial` at 220.
SUITES: dict[str, tuple[int, int]] = {
    "spatial": (10, 280),
    "object": (10, 280),
    "goal": (10, 300),
    "10": (10, 520),
    "90": (90, 400),
}
ALL = "all"  # the four suites of ten, which are what papers report
_REPORTED = ("spatial", "object", "goal", "10")

# The simulator's cameras by the picture names of data sets: LeRobot's, openpi's and LIBERO's own.
CAMERAS = {
    "image": "agentview",
    "image2": "robot0_eye_in_hand",
    "wrist_image": "robot0_eye_in_hand",
    "agentview": "agentview",
    "agentview_rgb": "agentview",
    "robot0_eye_in_hand": "robot0_eye_in_hand",
    "eye_in_hand_rgb": "robot0_eye_in_hand",
}

_TASK = TaskSpec(
    name="",
    action_names=("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper"),
    proprio_names=("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad", "finger1_m", "finger2_m"),
    max_steps=0,
    control_hz=20.0,
    templates=(),
    camera="image",
    said_hz=10.0,  # stated in LeRobot's and openpi's copies of the demonstrations
)


def names() -> tuple[str, ...]:
    """The names of all sets, suites and tasks in `aegis`."""
    tasks = (task for suite in SUITES for task in members(LIBERO + suite))
    return (*(LIBERO + name for name in (ALL, *SUITES)), *tasks)


def members(name: str) -> tuple[str, ...]:
    """The tasks of a suite, or of all four, in LIBERO's order; for a task, only itself."""
    short = name.removeprefix(LIBERO)
    if short == ALL:
        return tuple(task for suite in _REPORTED for task in members(LIBERO + suite))
    if short not in SUITES:
        return (name,)
    count, _ = SUITES[short]
    return tuple(f"{name}-{number}" for number in range(count))


def suites(name: str) -> tuple[str, ...]:
    """The suites in the set of all four; empty for a single suite or a task."""
    return tuple(LIBERO + suite for suite in _REPORTED) if name == LIBERO + ALL else ()


def place(task: str) -> tuple[str, int]:
    """The suite of a single task, and its number there."""
    suite, _, number = task.removeprefix(LIBERO).partition("-")
    return suite, int(number)


def instructions(name: str) -> tuple[str, ...]:
    """The instruction of a task, or of each task of a suite or a set."""
    places = map(place, members(name))
    return tuple(INSTRUCTIONS[suite][number] for suite, number in places)


def told(instruction: str) -> tuple[str, ...]:
    """The tasks with this instruction, ignoring case; a few in different scenes share one."""
    return _told().get(instruction.strip().lower(), ())


@cache
def _told() -> dict[str, tuple[str, ...]]:
    found: dict[str, tuple[str, ...]] = {}
    for suite, texts in INSTRUCTIONS.items():
        for number, text in enumerate(texts):
            found[text] = (*found.get(text, ()), f"{LIBERO}{suite}-{number}")
    return found


def steps(task: str) -> int:
    """The most steps in an episode of a single task."""
    suite, _ = place(task)
    return SUITES[suite][1]


def spec(name: str, instructions: tuple[str, ...] = ()) -> TaskSpec:
    """The facts of a task, a suite or a set, with the limit of its longest episodes."""
    longest = max(steps(task) for task in members(name))
    return replace(_TASK, name=name, max_steps=longest, templates=instructions)
