"""Checks of both plugins against the LeRobot that is installed; exit 1 if one fails.

    python -m venv .venv-lerobot && . .venv-lerobot/bin/activate
    pip install 'lerobot[smolvla,training,evaluation]==0.6.1'
    pip install -e '.[hf]' -e plugins/lerobot_policy_aegis -e plugins/lerobot_env_aegis
    python plugins/check/check.py

It takes about ten minutes of two cores, and is no part of the tests.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("HF_HUB_OFFLINE", "1")  # nothing is fetched

import augmentation
import foreign_vlm
import numpy as np
import robot
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.envs import make_env, make_env_pre_post_processors
from lerobot.lerobot_types import TransitionKey
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.processor import RelativeActionsProcessorStep
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.constants import OBS_STATE
from lerobot.utils.import_utils import register_third_party_plugins
from programs import command, remove
from safetensors.torch import load_file, save_file
from smolvla_in_miniature import save_smolvla, save_vlm
from torch import Tensor

import aegis_cli
from aegis_cli.anchors import anchor_file
from aegis_cli.common.errors import AegisError
from aegis_cli.core import nullspace
from aegis_cli.core.nullspace import Strength
from aegis_cli.data import relative
from aegis_cli.models import backbones

ENERGY = 0.9  # share of the VLM's inputs that is protected
LIMITS = {"actions": 1e-6, "orthogonal": 1e-5}
STEPS = 20
TRAIN = (
    "--num_workers=0",
    "--env_eval_freq=0",
    "--policy.device=cpu",
    "--policy.push_to_hub=false",
    "--wandb.enable=false",
)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument(
        "--keep", type=Path, help="folder to work in, which is kept; each check makes its part anew"
    )
    keep = options.parse_args().keep
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        sys.exit(1 if failures(keep.resolve()) else 0)
    with tempfile.TemporaryDirectory(prefix="aegis-lerobot-", ignore_cleanup_errors=True) as name:
        failed = failures(Path(name))
    sys.exit(1 if failed else 0)


def failures(folder: Path) -> int:
    """Run all checks in the folder, and say of each how it went; how many have failed."""
    os.environ["HF_HOME"] = str(folder / "hf")
    register_third_party_plugins()
    checks: tuple[Callable[[Path], str], ...] = (
        discovery,
        a_run_and_its_export,
        actions_of_the_evaluation,
        the_evaluation_itself,
        answers,
        a_missing_tensor,
        a_training_and_its_resumption,
        a_protected_training_and_its_resumption,
        a_hugging_face_backbone,
        robot.a_robot_is_recorded_and_learned,
        robot.a_robot_does_what_load_policy_says,
        robot.a_robot_acts_in_real_time,
        robot.a_robot_that_compiles,
        robot.a_robot_records_what_it_does,
        robot.another_robot_is_refused,
        smolvla_moves_orthogonally,
        smolvla_at_strength_0_is_adamw,
        foreign_vlm.smolvla_gives_and_takes_its_vlm,
        foreign_vlm.pi0_gives_and_takes_its_vlm,
        foreign_vlm.pi05_gives_and_takes_its_vlm,
        foreign_vlm.pi0_fast_gives_its_vlm,
        frames_are_augmented_as_by_torchvision,
        actions_are_relative_as_in_lerobot,
    )
    failed = 0
    for check in checks:
        name = check.__name__.replace("_", " ")
        try:
            print(f"ok      {name}: {check(folder)}", flush=True)
        except Exception as error:  # a check that cannot run keeps none of the others from running
            failed += 1
            print(f"FAILED  {name}: {type(error).__name__}: {error}", flush=True)
    return failed


# --- the policy -----------------------------------------------------------------------------------


def discovery(_: Path) -> str:
    from importlib.metadata import version

    from lerobot.envs.configs import EnvConfig
    from lerobot.optim import OptimizerConfig

    assert "aegis" in PreTrainedConfig.get_known_choices()
    assert "aegis" in EnvConfig.get_known_choices()
    assert {"aegis_kfac", "aegis_nullspace"} <= OptimizerConfig.get_known_choices().keys()
    versions = (f"{name} {version(name)}" for name in ("lerobot", "torch", "transformers"))
    return f"Python {sys.version.split()[0]}, {', '.join(versions)}"


def a_run_and_its_export(folder: Path) -> str:
    """A run of 20 steps, its demonstrations as a LeRobot dataset, its export, an anchor."""
    recipe = Path(__file__).parents[2] / "recipes" / "reach.yaml"
    for name in ("reach.safetensors", "dataset", "run", "policy", "anchor.safetensors"):
        remove(folder / name)
    record = ("demos", "reach", "--episodes", "8")
    command("aegis", *record, "--out", folder / "reach.safetensors")
    command("aegis", *record, "--format", "lerobot", "--out", folder / "dataset")
    short = ("steps=20", "batch_size=8", "flow_samples=2")
    settings = [part for value in short for part in ("--set", f"train.{value}")]
    demos = ("--demos", folder / "reach.safetensors")
    command("aegis", "train", recipe, *demos, "--out", folder / "run", *settings)
    command("aegis", "export", folder / "run", "--out", folder / "policy")
    parts = ("--parts", "inputs,curvature", "--samples", "60")
    command("aegis", "anchor", *parts, "--out", folder / "anchor.safetensors")
    return ", ".join(sorted(path.name for path in (folder / "policy").iterdir()))


def actions_of_the_evaluation(folder: Path) -> str:
    """The actions of `lerobot-eval` are those of `load_policy` on the same observations."""
    from lerobot_env_aegis import AegisEnvConfig
    from lerobot_env_aegis.task_env import AegisTask

    seed, steps = 3, 12
    env_config = AegisEnvConfig(task="reach", episode_length=steps)
    config = PreTrainedConfig.from_pretrained(folder / "policy")
    config.pretrained_path, config.device = folder / "policy", "cpu"
    environments = make_env(env_config, n_envs=1)["reach"][0]
    policy = make_policy(config, env_cfg=env_config)
    overrides = {"device_processor": {"device": "cpu"}}
    before, after = make_pre_post_processors(
        config, folder / "policy", preprocessor_overrides=overrides
    )
    first, last = make_env_pre_post_processors(env_config, config)
    found = rollout(
        environments, policy, first, last, before, after, [seed], return_observations=True
    )
    task = AegisTask("reach", "seen", "top")
    task.reset(seed=seed)
    own = aegis_cli.load_policy(folder / "run")
    own.reset()
    pictures = (found["observation"]["observation.images.top"][0] * 255).round().to(torch.uint8)
    positions = found["observation"]["observation.state"][0]
    differences = []
    for step, action in enumerate(found["action"][0].numpy()):
        frame = pictures[step].permute(1, 2, 0).numpy()
        mine = own.select_action(frame, task.task_description, positions[step].numpy())
        differences.append(float(np.abs(mine - action).max()))
    assert max(differences) <= LIMITS["actions"], f"they differ by {max(differences):.2g}"
    return f"{len(differences)} steps, largest difference {max(differences):.2g}"


def the_evaluation_itself(folder: Path) -> str:
    """`lerobot-eval` with two environments at a time, in processes of their own."""
    out = remove(folder / "eval")
    command(
        "lerobot-eval",
        f"--policy.path={folder / 'policy'}",
        "--policy.device=cpu",
        "--env.type=aegis",
        "--env.task=reach",
        "--env.episode_length=20",
        "--eval.n_episodes=4",
        "--eval.batch_size=2",
        "--seed=0",
        f"--output_dir={out}",
    )
    overall = json.loads((out / "eval_info.json").read_text())["overall"]
    assert overall["n_episodes"] == 4 and overall["video_paths"]
    return f"success {overall['pc_success']:.0f} % of {overall['n_episodes']} episodes"


def answers(folder: Path) -> str:
    """`generate_text` says what the run's VLM says."""
    policy = loaded(folder / "policy")
    vlm = backbones.load(str(folder / "run"))
    images = torch.randint(0, 256, (2, 64, 64, 3), dtype=torch.uint8)
    questions = ["what color is the cylinder", "how many things are there"]
    batch = {"observation.images.top": images.permute(0, 3, 1, 2).float() / 255}
    said = policy.generate_text(batch, questions)
    assert said == vlm.answer(images, questions), said
    return ", ".join(said)


def a_missing_tensor(folder: Path) -> str:
    """A file without one tensor is refused, and so is one that another program wrote."""
    broken = remove(folder / "broken")
    shutil.copytree(folder / "policy", broken)
    from aegis_cli.common import artifacts

    path = broken / "model.safetensors"
    whole = artifacts.load(path, "policy")
    tensors = {name: tensor.clone() for name, tensor in whole.tensors.items()}
    del tensors["model.expert.layers.0.up.weight"]
    header = whole.header
    artifacts.save(path, "policy", tensors, fingerprint=header.fingerprint, meta=header.meta)
    said = refused(lambda: loaded(broken))
    assert "missing" in said, said
    save_file(load_file(folder / "policy" / "model.safetensors"), path)
    assert "another program" in refused(lambda: loaded(broken))
    return said


# --- training -------------------------------------------------------------------------------------


def a_training_and_its_resumption(folder: Path) -> str:
    """20 steps, and the same when they are interrupted after 10."""
    return resumed(folder, "naive", ("--policy.type=aegis", "--policy.flow_samples=2"))


def a_protected_training_and_its_resumption(folder: Path) -> str:
    """The same with the optimizer that the method `kfac` chooses."""
    anchor = f"--policy.anchor={folder / 'anchor.safetensors'}"
    chosen = ("--policy.type=aegis", "--policy.flow_samples=2", "--policy.method=kfac", anchor)
    return resumed(folder, "kfac", chosen)


def a_hugging_face_backbone(folder: Path) -> str:
    """A new policy on a small SmolVLM2: trained, saved with its processor, asked and rolled out."""
    vlm, out = remove(folder / "vlm"), remove(folder / "hugging-face")
    save_vlm(vlm)
    train(
        folder,
        out,
        "--policy.type=aegis",
        f"--policy.backbone={vlm}",
        "--policy.normalization=quantiles",
        "--steps=2",
    )
    saved = out / "checkpoints" / "last" / "pretrained_model"
    policy = loaded(saved)
    images = torch.randint(0, 256, (2, 64, 64, 3), dtype=torch.uint8)
    batch = {"observation.images.top": images.permute(0, 3, 1, 2).float() / 255}
    questions = ["how many things are there"] * 2
    said = backbones.load(str(saved)).answer(images, questions)
    assert policy.generate_text(batch, questions) == said
    command("aegis", "rollout", saved, "--task", "reach", "--episodes", "1")
    return ", ".join(sorted(path.name for path in (saved / "backbone").iterdir()))


def resumed(folder: Path, name: str, policy: tuple[str, ...]) -> str:
    whole, again = remove(folder / name), remove(folder / f"{name}-resumed")
    half = STEPS // 2
    train(folder, whole, *policy, f"--steps={STEPS}", f"--save_freq={half}")
    shutil.copytree(whole, again, symlinks=True)
    shutil.rmtree(again / "checkpoints" / f"{STEPS:06d}")
    (again / "checkpoints" / "last").unlink()
    (again / "checkpoints" / "last").symlink_to(f"{half:06d}")
    saved = again / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    command("lerobot-train", f"--config_path={saved}", "--resume=true", f"--output_dir={again}")
    ends = [tensors_of(path / "checkpoints" / "last") for path in (whole, again)]
    assert ends[0].keys() == ends[1].keys()
    far = max(float((t.float() - ends[1][n].float()).abs().max()) for n, t in ends[0].items())
    assert far == 0, f"the resumed weights differ by {far:.2g}"
    command(
        "aegis",
        "rollout",
        whole / "checkpoints" / "last" / "pretrained_model",
        *("--task", "reach", "--episodes", "1"),
    )
    return f"{STEPS} steps, and {half} resumed to {STEPS}: equal bit for bit; aegis rolls it out"


# --- LeRobot's own policies -----------------------------------------------------------------------


def smolvla_moves_orthogonally(folder: Path) -> str:
    """What `lerobot-train` did to SmolVLA's VLM is orthogonal to what questions span."""
    start, anchor = smolvla(folder)
    options = (
        "--optimizer.type=aegis_nullspace",
        f"--optimizer.anchor={anchor}",
        f"--optimizer.base={folder / 'vlm'}",
        f"--optimizer.energy={ENERGY}",
        "--optimizer.lr=1e-2",  # so that the rounding of weights is small beside an update
    )
    end = train_smolvla(folder, start, "orthogonal", options)
    base = backbones.load(str(folder / "vlm"))
    wanted = anchor_file.Wanted(base.fingerprint(), str(folder / "vlm"), "--base ")
    measured = anchor_file.load(anchor, wanted)
    before, after = tensors_of(start.parent / start.name), tensors_of(end)
    inside = "model.vlm_with_expert."  # whose VLM is named as ours: vlm.
    moved = {
        name.removeprefix(inside): after[name] - tensor
        for name, tensor in before.items()
        if name.startswith(inside)
    }
    learned = [name for name, by in moved.items() if name.startswith("vlm.") and by.any()]
    sites = [s for s in base.sites() if f"{s}.weight" in learned]
    likes = {site: base.get_submodule(site).weight for site in sites}
    worst = 0.0
    for site, protection in nullspace.protections(measured, likes, Strength(ENERGY)).items():
        update = (moved[f"{site}.weight"], moved.get(f"{site}.bias"))
        along = norm_of(protection.removed(*update))
        worst = max(worst, along / norm_of(update))
    expert = [n for n, by in moved.items() if n.startswith("lm_expert.") and by.any()]
    assert sites and expert
    assert worst <= LIMITS["orthogonal"], f"{worst:.2g} of an update is along the span"
    return f"{len(sites)} sites, largest share of an update along the span {worst:.2g}"


def norm_of(pair: nullspace.Pair) -> float:
    """The Euclidean norm of a map's weight and bias together."""
    return float(sum(part.square().sum() for part in pair if part is not None).sqrt())


def smolvla_at_strength_0_is_adamw(folder: Path) -> str:
    """Weight 0, or energy 0, gives AdamW's weights bit for bit."""
    start, anchor = smolvla(folder)
    protected = (f"--optimizer.anchor={anchor}", f"--optimizer.base={folder / 'vlm'}")
    off = {
        "aegis_kfac": ("--optimizer.weight=0", "--optimizer.balance=0", *protected),
        "aegis_nullspace": ("--optimizer.energy=0", *protected),
    }
    ends = {}
    for kind in ("adamw", *off):
        own = off.get(kind, ())
        options = (f"--optimizer.type={kind}", "--optimizer.lr=1e-3", *own)
        ends[kind] = tensors_of(train_smolvla(folder, start, f"zero-{kind}", options))
    plain = ends["adamw"]
    moved = {name for name, t in tensors_of(start).items() if not torch.equal(t, plain[name])}
    assert any(".vlm." in name for name in moved)
    for kind in off:
        unequal = [n for n, t in plain.items() if not torch.equal(t, ends[kind][n])]
        assert not unequal, f"{kind}: {unequal[:3]}"
    return f"{len(plain)} tensors equal, {len(moved)} of which have moved"


def smolvla(folder: Path) -> tuple[Path, Path]:
    """A small SmolVLA with the weights of a small SmolVLM2, and that VLM's anchor."""
    start, anchor = folder / "smolvla", folder / "vlm-anchor.safetensors"
    vlm = remove(folder / "vlm")
    save_vlm(vlm)
    save_smolvla(remove(start), vlm, folder / "dataset")
    parts = ("--parts", "inputs,curvature", "--samples", "40", "--energy", "1")
    command("aegis", "anchor", "--backbone", vlm, *parts, "--out", remove(anchor))
    return start, anchor


def train_smolvla(folder: Path, start: Path, name: str, optimizer: tuple[str, ...]) -> Path:
    out = remove(folder / name)
    train(
        folder,
        out,
        f"--policy.path={start}",
        "--policy.train_expert_only=false",
        "--policy.freeze_vision_encoder=false",
        "--use_policy_training_preset=false",
        "--scheduler.type=cosine_decay_with_warmup",
        "--scheduler.num_warmup_steps=1",
        "--scheduler.num_decay_steps=10",
        "--scheduler.peak_lr=1e-3",
        "--scheduler.decay_lr=1e-4",
        *optimizer,
        "--optimizer.weight_decay=0.1",
        "--optimizer.grad_clip_norm=10",
        "--steps=4",
        "--save_freq=4",
    )
    return out / "checkpoints" / "last"


# --- frames ---------------------------------------------------------------------------------------


def frames_are_augmented_as_by_torchvision(_: Path) -> str:
    found = augmentation.differences()
    changed = {name: worst for name, worst in found.items() if worst > augmentation.CLOSE}
    assert not changed, f"largest differences: {changed}"
    return f"{len(found)} transformations, largest difference {max(found.values()):.2g}"


def actions_are_relative_as_in_lerobot(_: Path) -> str:
    names = ["shoulder.pos", "elbow.pos", "gripper.pos"]
    places = relative.places(names, names, (3, 3), ["gripper"])
    theirs = RelativeActionsProcessorStep(True, ["gripper"], names)
    generator = torch.Generator().manual_seed(0)
    state = torch.randn(4, 3, generator=generator)
    actions = torch.randn(4, 6, 3, generator=generator)
    seen = {TransitionKey.ACTION: actions, TransitionKey.OBSERVATION: {OBS_STATE: state}}
    difference = theirs(seen)[TransitionKey.ACTION] - (actions - relative.Origins(places)(state))
    worst = float(difference.abs().max())
    assert worst == 0, f"largest difference {worst:.2g}"
    return "train.relative_actions and use_relative_actions agree to the bit"


# --- commands and files ---------------------------------------------------------------------------


def train(folder: Path, out: Path, *options: str) -> None:
    data = ("--dataset.repo_id=local/reach", f"--dataset.root={folder / 'dataset'}")
    command("lerobot-train", *data, "--batch_size=4", f"--output_dir={out}", *TRAIN, *options)


def loaded(folder: Path) -> torch.nn.Module:
    from lerobot_policy_aegis.modeling_aegis import AegisPolicy

    return AegisPolicy.from_pretrained(folder)


def refused(load: Callable[[], object]) -> str:
    try:
        load()
    except AegisError as error:
        return error.found
    raise AssertionError("it was not refused")


def tensors_of(folder: Path) -> dict[str, Tensor]:
    """The weights of a policy's folder, or of a checkpoint's."""
    inner = folder / "pretrained_model"
    return load_file((inner if inner.is_dir() else folder) / "model.safetensors")


if __name__ == "__main__":
    main()
