"""Checks of LeRobot's programs for robots: an SO-101 in miniature is recorded, learned, driven."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
from lerobot_robot_miniature import MOTORS, picture
from programs import command, remove, run
from smolvla_in_miniature import save_vlm

import aegis_cli
from aegis_cli.data.lerobot import dataset

TASK, FPS, CAMERAS = "put the cube into the box", 15, ("front", "wrist")
SIZE = (480, 640)  # of what the robot sees; the recording is smaller
FOLLOWER = (
    "--robot.discover_packages_path=lerobot_robot_miniature",
    "--robot.type=miniature_follower",
    "--play_sounds=false",
)


def a_robot_is_recorded_and_learned(folder: Path) -> str:
    """`lerobot-record` with a leader arm, `aegis train` of both cameras, `aegis export`."""
    for name in ("arm", "arm-vlm", "arm-run", "arm-policy"):
        remove(folder / name)
    command(
        "lerobot-record",
        *FOLLOWER,
        "--teleop.type=miniature_leader",
        *_recording(folder, "arm"),
        *("--dataset.num_episodes=3", "--dataset.episode_time_s=2", "--dataset.reset_time_s=0"),
    )
    save_vlm(folder / "arm-vlm")
    cameras = ", ".join(f"observation.images.{name}" for name in CAMERAS)
    settings = (
        *("train.steps=10", "train.batch_size=8", "train.flow_samples=2", "train.warmup=2"),
        *(f"backbone={folder / 'arm-vlm'}", f"demos.camera=[{cameras}]"),
    )
    chosen = [part for value in settings for part in ("--set", value)]
    recipe = Path(__file__).parents[2] / "recipes" / "reach.yaml"
    demos, out = ("--demos", folder / "arm"), folder / "arm-run"
    command("aegis", "train", recipe, "--method", "naive", *demos, "--out", out, *chosen)
    command("aegis", "export", out, "--format", "lerobot", "--out", folder / "arm-policy")
    card = (folder / "arm-policy" / "README.md").read_text("utf-8")
    assert f"--fps={FPS}" in card
    return f"{dataset.load(folder / 'arm').info.frames} frames"


def a_robot_does_what_load_policy_says(folder: Path) -> str:
    """`lerobot-rollout` sends what the run says of the same observations, at the rate asked for."""
    log, said = _roll_out(folder, "--strategy.type=base")
    assert f"--fps={FPS}" in said and ", ".join(f"{name}.pos" for name in MOTORS) in said
    policy = aegis_cli.load_policy(folder / "arm-run")
    worst, pairs = 0.0, _acted(log)
    for seen, sent in pairs:
        frames = {name: picture(name, seen["number"], *SIZE) for name in CAMERAS}
        action = policy.named(policy.select_action({**seen["positions"], **frames}, TASK))
        assert [*action] == [*sent["action"]]
        worst = max(worst, *(abs(action[name] - at) for name, at in sent["action"].items()))
    assert pairs and worst == 0, f"{len(pairs)} actions differ by up to {worst:.2g}"
    assert len(pairs) > 1, "one action only: the machine is too busy to tell the rate"
    rate = (len(pairs) - 1) / (pairs[-1][1]["time"] - pairs[0][1]["time"])
    assert rate < 1.05 * FPS, f"{rate:.1f} actions a second instead of {FPS}"
    return f"{len(pairs)} actions, the same to the bit, {rate:.1f} of {FPS} a second"


def a_robot_acts_in_real_time(folder: Path) -> str:
    """`--inference.type=rtc`: finite actions by the motors' names, also of another order."""
    turned = ",".join(reversed(MOTORS))
    counts = []
    for motors in (",".join(MOTORS), turned):
        options = ("--strategy.type=base", "--inference.type=rtc", f"--robot.motors=[{motors}]")
        log, said = _roll_out(folder, *options)
        assert "RTC inference error" not in said, said
        sent = [sent["action"] for _, sent in _acted(log)]
        assert all([*each] == [f"{name}.pos" for name in MOTORS] for each in sent)
        assert sent and np.isfinite([[*each.values()] for each in sent]).all()
        counts.append(len(sent))
    return f"{counts} actions"


def a_robot_that_compiles(folder: Path) -> str:
    """`--use_torch_compile` says that it does nothing, and does nothing."""
    log, said = _roll_out(folder, "--strategy.type=base", "--use_torch_compile=true")
    assert said.count("Nothing is compiled") == 1
    return f"{len(_acted(log))} actions"


def a_robot_records_what_it_does(folder: Path) -> str:
    """`--strategy.type=sentry` records while it acts, and `aegis evaluate` reads that."""
    options = ("--strategy.type=sentry", *_recording(folder, "rollout_arm"))
    log, _ = _roll_out(folder, *options)
    seen, sent = dataset.load(folder / "rollout_arm").info.frames, len(_acted(log))
    assert seen == sent, f"{seen} frames of {sent} actions"
    command("aegis", "evaluate", folder / "arm-policy", "--demos", folder / "rollout_arm")
    return f"{seen} frames"


def another_robot_is_refused(folder: Path) -> str:
    """One motor more, a camera less, and cameras by other names: nothing is sent to any."""
    refusals = {
        f"--robot.motors=[{','.join(MOTORS)},extra]": r"state of shape \(1, 7\).*\n.*gripper\.pos$",
        "--robot.views=[front]": "no picture observation.images.wrist",
        "--robot.views=[front,top]": "Visual feature mismatch",  # which LeRobot says
    }
    for option, expected in refusals.items():
        log = remove(folder / "arm.jsonl")
        done = _run(folder, log, "--strategy.type=base", option)
        assert done.returncode and re.search(expected, done.stderr, re.M), done.stderr[-2000:]
        assert not _acted(log)
    return f"{len(refusals)} of them"


def _recording(folder: Path, name: str) -> tuple[str, ...]:
    """LeRobot's options for a data set that is written into a folder of that name."""
    return (
        f"--dataset.repo_id=local/{name}",
        f"--dataset.root={remove(folder / name)}",
        f"--dataset.fps={FPS}",
        f"--dataset.single_task={TASK}",
        "--dataset.push_to_hub=false",
        "--dataset.streaming_encoding=true",
    )


def _roll_out(folder: Path, *options: str) -> tuple[Path, str]:
    """The log of a robot that acts for two seconds, and what LeRobot said."""
    log = remove(folder / "arm.jsonl")
    done = _run(folder, log, *options)
    assert not done.returncode, done.stderr[-4000:]
    return log, done.stderr


def _run(folder: Path, log: Path, *options: str) -> subprocess.CompletedProcess[str]:
    return run(
        "lerobot-rollout",
        *FOLLOWER,
        f"--robot.log={log}",
        *(f"--robot.height={SIZE[0]}", f"--robot.width={SIZE[1]}"),
        f"--policy.path={folder / 'arm-policy'}",
        "--policy.device=cpu",
        *(f"--task={TASK}", f"--fps={FPS}", "--duration=2"),
        "--return_to_initial_position=false",  # what it then sends is none of the policy's
        *options,
    )


def _acted(log: Path) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Each observation that an action was sent after, with the action."""
    lines = [json.loads(line) for line in log.read_text("utf-8").splitlines()]
    pairs = zip(lines, lines[1:], strict=False)
    return [(a, b) for a, b in pairs if (a["what"], b["what"]) == ("observed", "sent")]
