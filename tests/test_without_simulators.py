"""A robot's computer needs no simulator: only what plays or renders imports one."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from samples import own_robots, small_run


def test_what_does_not_simulate_needs_no_simulator(tiny_folder: Path, tmp_path: Path) -> None:
    """Training, evaluating and acting on recorded data, serving and the guard."""
    program = """
import contextlib, sys
sys.modules['mujoco'] = sys.modules['dm_control'] = None  # as if they were not installed
from pathlib import Path
import aegis_cli, aegis_cli.serving.server, aegis_cli.serving.latency
import numpy as np
from aegis_cli import Guard, load_policy
from aegis_cli.cli.app import main

def call(*words):
    sys.argv = ['aegis', *words]
    with contextlib.suppress(SystemExit):
        main()

recipe, demos, folder = sys.argv[1:]
call('--help')
call('train', recipe, '--method', 'naive', '--demos', demos, '--out', folder)
call('evaluate', folder, '--demos', demos, '--frames', '3')
assert Path(folder, 'results').is_dir()
policy = load_policy(folder)
policy.select_action(np.zeros((16, 16, 3), np.uint8), 'go to the red target', [0.0] * 3)
"""
    demos = own_robots.robot(tmp_path / "demos")
    recipe = small_run.write(tmp_path, tiny_folder, methods=("naive",), steps=2)
    command = [sys.executable, "-c", program, recipe, demos, tmp_path / "run"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
