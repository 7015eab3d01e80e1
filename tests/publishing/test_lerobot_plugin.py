"""The plugin's policy, tested with a stand-in for LeRobot."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from samples.training import make_policy, policy_over
from torch import nn

from aegis_cli.common.errors import AegisError
from aegis_cli.deploy import DeployedPolicy
from aegis_cli.models import backbones, lerobot_folder
from aegis_cli.models.policy import Policy
from aegis_cli.recipes import Recipe, Train
from aegis_cli.training import checkpoint
from aegis_cli.training.schedule import rate_factor

SOURCE = Path(__file__).parents[2] / "plugins" / "lerobot_policy_aegis" / "src"
IMAGE, WRIST = "observation.image", "observation.images.wrist"


class FeatureType(Enum):
    STATE, VISUAL, ENV, ACTION = range(4)


class NormalizationMode(Enum):
    IDENTITY = 0


@dataclass
class PolicyFeature:
    type: FeatureType
    shape: tuple[int, ...]


@dataclass
class Registered:
    """What LeRobot finds by a name, and the base of the plugin's optimizers."""

    @classmethod
    def register_subclass(cls, _: str) -> Callable[[type], type]:
        return lambda registered: registered


@dataclass
class Preset:
    """The fields of LeRobot's AdamW that the plugin sets."""

    lr: float
    weight_decay: float
    grad_clip_norm: float


@dataclass
class PreTrainedConfig(Registered):
    """The features of a policy, as LeRobot distinguishes them."""

    input_features: dict[str, PolicyFeature] = field(default_factory=dict)
    output_features: dict[str, PolicyFeature] = field(default_factory=dict)
    device: str = "cpu"

    def __post_init__(self) -> None:
        pass

    @property
    def image_features(self) -> dict[str, PolicyFeature]:
        found = self.input_features.items()
        return {name: each for name, each in found if each.type is FeatureType.VISUAL}

    @property
    def robot_state_feature(self) -> PolicyFeature | None:
        return self.input_features.get("observation.state")

    @property
    def action_feature(self) -> PolicyFeature | None:
        return self.output_features.get("action")

    def _save_pretrained(self, save_directory: Path) -> None:
        (save_directory / "config.json").write_text('{"type": "aegis"}')


class PreTrainedPolicy(nn.Module):
    def __init__(self, config: PreTrainedConfig) -> None:
        super().__init__()


STAND_IN: dict[str, dict[str, Any]] = {
    "lerobot": {},
    "lerobot.configs": {
        "FeatureType": FeatureType,
        "NormalizationMode": NormalizationMode,
        "PreTrainedConfig": PreTrainedConfig,
    },
    "lerobot.optim": {
        "AdamWConfig": Preset,
        "LRSchedulerConfig": Registered,
        "OptimizerConfig": Registered,
    },
    "lerobot.policies": {"PreTrainedPolicy": PreTrainedPolicy},
    "lerobot.utils": {},
    "lerobot.utils.constants": {"ACTION": "action", "OBS_STATE": "observation.state"},
}


@pytest.fixture
def plugin(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The plugin's module of policies, on the stand-in; both are removed afterwards."""
    for name, content in STAND_IN.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.syspath_prepend(str(SOURCE))
    from lerobot_policy_aegis import modeling_aegis

    yield modeling_aegis
    for name in [name for name in sys.modules if name.startswith("lerobot_policy_aegis")]:
        del sys.modules[name]


def config(plugin: Any, model: Policy, *pictures: str) -> Any:
    features = {name: PolicyFeature(FeatureType.VISUAL, (3, 30, 40)) for name in pictures}
    positions = (len(model.proprio_scale.mean),)
    features["observation.state"] = PolicyFeature(FeatureType.STATE, positions)
    actions = PolicyFeature(FeatureType.ACTION, (len(model.action_scale.mean),))
    return plugin.AegisConfig(features, {"action": actions}, chunk_size=model.expert.shape.chunk)


def saved(plugin: Any, model: Policy, folder: Path, *pictures: str) -> dict[str, Any]:
    """What is known of a policy after LeRobot has saved it."""
    folder.mkdir()
    plugin.AegisPolicy(config(plugin, model, *pictures), model=model)._save_pretrained(folder)
    return checkpoint.load_policy(folder)[1]


@pytest.mark.parametrize(
    ("picture", "name"), [(IMAGE, IMAGE), (WRIST, "wrist"), ("observation.images.a.b", "a.b")]
)
def test_a_picture_that_was_saved_is_found_again_by_its_name(
    picture: str, name: str, plugin: Any, tmp_path: Path
) -> None:
    model = make_policy().eval()
    meta = saved(plugin, model, tmp_path / "x", picture)
    assert meta["cameras"] == [name]
    again = plugin.AegisPolicy(config(plugin, model, picture), model=model, meta=meta)
    assert again._cameras == [picture]
    shown = {picture: torch.zeros(1, 3, 30, 40)}
    assert len(again._images(shown)) == 1


def test_pictures_are_taken_in_the_order_of_training_whatever_they_are_called(
    plugin: Any, hf_folder: Callable[[str], Path], tmp_path: Path
) -> None:
    model = policy_over(backbones.load(str(hf_folder("smolvlm")))).eval()
    meta = saved(plugin, model, tmp_path / "x", WRIST, IMAGE)
    assert meta["cameras"] == ["wrist", IMAGE]
    again = plugin.AegisPolicy(config(plugin, model, IMAGE, WRIST), model=model, meta=meta)
    assert again._cameras == [WRIST, IMAGE]


def test_a_policy_that_was_exported_with_an_invented_name_still_loads(plugin: Any) -> None:
    model, invented = make_policy().eval(), f"{lerobot_folder.IMAGES}{IMAGE}"
    meta = {"task": None, "normalization": "mean_std", "cameras": [IMAGE]}
    policy = plugin.AegisPolicy(config(plugin, model, invented), model=model, meta=meta)
    assert policy._cameras == [invented]


def test_other_pictures_are_refused_with_the_names_of_training(plugin: Any) -> None:
    model = make_policy().eval()
    meta = {"task": None, "normalization": "mean_std", "cameras": [IMAGE]}
    with pytest.raises(AegisError, match=f"{WRIST}\nexpected: {IMAGE}\n"):
        plugin.AegisPolicy(config(plugin, model, WRIST), model=model, meta=meta)


# --- scales ---------------------------------------------------------------------------------------

STILL = {  # the third number never moved; LeRobot then states a deviation of 0, or a rounding error
    "action": {
        "mean": [0.5, -1.0, 0.25],
        "std": [0.2, 1e-4, 1e-9],
        "min": [0.0, -1.001, 0.25],
        "max": [1.0, -0.999, 0.25],
        "q01": [0.1, -1.0, 0.25],  # the second one closes in less than one frame of a hundred
        "q99": [0.9, -1.0, 0.25],
    }
}


@pytest.mark.parametrize("normalization", ["mean_std", "quantiles"])
def test_an_action_that_never_moved_is_not_predicted_as_noise(
    plugin: Any, normalization: str
) -> None:
    """As in `aegis train`: a scale of 0 gives its one value, whatever is predicted."""
    scale = plugin._scale(STILL, "action", normalization)
    assert (scale.std == 0).tolist() == [False, False, True]
    predicted = scale.invert(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)))
    assert (predicted[:, 2] == 0.25).all() and predicted[:, 1].std() > 0
    assert plugin._spread(STILL, "action").tolist() == [0.2, 1e-4, 0.0]


def test_statistics_without_extremes_say_of_nothing_that_it_never_moved(plugin: Any) -> None:
    told = {name: STILL["action"][name] for name in ("mean", "std")}
    scale = plugin._scale({"action": told}, "action", "mean_std")
    assert (scale.std != 0).all()
    assert plugin._spread({"action": {"mean": [0.0]}}, "action") is None


# --- acting ---------------------------------------------------------------------------------------

TEXT, OTHER = "go to the red target", "go to the blue target"


def acting(plugin: Any) -> Any:
    """A policy that predicts at every second call."""
    model = make_policy().eval()
    made = config(plugin, model, IMAGE)
    made.n_action_steps = 2
    return plugin.AegisPolicy(made, model=model)


def seen(text: str = TEXT, state: torch.Tensor | None = None, shade: float = 0.0) -> dict[str, Any]:
    positions = torch.tensor([[0.3, -0.1, 0.2]]) if state is None else state
    picture = torch.full((1, 3, 30, 40), shade)
    return {IMAGE: picture, "observation.state": positions, "task": [text]}


NAMED = {"task": None, "normalization": "mean_std", "proprio_names": ["x", "y", "z"]}
BAD_STATES = [
    (torch.tensor([[0.0, math.nan, 0.0]]), "not finite"),
    (torch.tensor([[0.0, math.inf, 0.0]]), "not finite"),
    (torch.zeros(1, 2), r"\(1, 2\).*\n.*\(1, 3\)"),
    (torch.zeros(3), r"\(3,\).*\n.*\(1, 3\)"),
    (torch.zeros(2, 3), r"\(2, 3\).*\n.*\(1, 3\)"),
]


@pytest.mark.parametrize(("state", "says"), BAD_STATES)
def test_a_broken_sensor_is_refused_at_every_call(
    state: torch.Tensor, says: str, plugin: Any
) -> None:
    """Even when a chunk continues: no action of an older prediction moves the robot."""
    fresh, begun = acting(plugin), acting(plugin)
    begun.select_action(seen())
    for policy in (fresh, begun):
        for act in (policy.select_action, policy.predict_action_chunk):
            with pytest.raises(AegisError, match=says):
                act(seen(state=state))
    assert torch.isfinite(begun.select_action(seen())).all()


def test_positions_that_are_too_few_are_named(plugin: Any) -> None:
    model = make_policy()
    policy = plugin.AegisPolicy(config(plugin, model, IMAGE), model=model, meta=NAMED)
    with pytest.raises(AegisError) as caught:
        policy.select_action(seen(state=torch.zeros(1, 2)))
    assert caught.value.expected == "(1, 3): x, y, z"


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_picture_that_is_not_finite_is_refused_at_every_call(value: float, plugin: Any) -> None:
    broken = seen()
    broken[IMAGE][0, 1, 5] = value
    fresh, begun = acting(plugin), acting(plugin)
    begun.select_action(seen())
    for policy in (fresh, begun):
        for act in (policy.select_action, policy.predict_action_chunk):
            with pytest.raises(AegisError, match=f"picture {IMAGE} with 40 values.* not finite"):
                act(broken)
    as_bytes = torch.zeros(1, 3, 30, 40, dtype=torch.uint8)
    assert torch.isfinite(fresh.select_action(seen() | {IMAGE: as_bytes})).all()


def test_a_batch_without_a_state_is_refused(plugin: Any) -> None:
    batch = seen()
    del batch["observation.state"]
    with pytest.raises(AegisError, match="observation.state none in a batch of 1"):
        acting(plugin).select_action(batch)


def test_another_task_drops_the_chunk_of_the_one_before(plugin: Any) -> None:
    """As in a deployed policy; the rest of a chunk is not resumed."""
    policy, other = acting(plugin), acting(plugin)
    chunks = [
        other.predict_action_chunk(seen(text, shade=shade))
        for text, shade in ((TEXT, 0.0), (OTHER, 0.2), (TEXT, 0.6))
    ]
    texts = (TEXT, OTHER, OTHER, TEXT, TEXT)
    taken = [policy.select_action(seen(text, shade=0.2 * i)) for i, text in enumerate(texts)]
    expected = [chunks[0][:, :1], chunks[1][:, :2], chunks[2][:, :2]]
    torch.testing.assert_close(torch.stack(taken, 1), torch.cat(expected, 1), rtol=0, atol=0)


@pytest.mark.parametrize(("delay", "filled"), [(2, 0), (1, 3), (5, 1), (None, 0)])
def test_lerobots_real_time_chunking_gets_the_chunks_of_load_policy(
    delay: int | None, filled: int, plugin: Any
) -> None:
    """LeRobot pads the rest of a chunk with zeros, and its delay may be longer."""
    own, policy = DeployedPolicy(make_policy().eval(), None, (), 2), acting(plugin)
    left = torch.linspace(-1, 1, 6).reshape(3, 2)
    given = torch.cat([left, torch.zeros(filled, 2)])
    assert policy.supports_rtc()
    found = policy.predict_action_chunk(seen(), inference_delay=delay, prev_chunk_left_over=given)
    picture = np.zeros((30, 40, 3), np.uint8)
    expected = own.predict_action_chunk(
        picture, TEXT, [0.3, -0.1, 0.2], left.numpy(), min(delay or 0, 3)
    )
    np.testing.assert_array_equal(found[0].numpy(), expected)


def test_more_than_a_chunk_can_continue_is_left_out(plugin: Any) -> None:
    """Later versions of LeRobot pad with the last action."""
    left = torch.linspace(-1, 1, 8).reshape(4, 2)
    longer = torch.cat([left, left[-1:].expand(6, 2)])
    given = {"inference_delay": 1, "prev_chunk_left_over": left}
    expected = acting(plugin).predict_action_chunk(seen(), **given)
    found = acting(plugin).predict_action_chunk(seen(), **given | {"prev_chunk_left_over": longer})
    assert torch.equal(found, expected)


@pytest.mark.parametrize("left", [None, torch.zeros(0, 2), torch.zeros(4, 2)])
def test_where_nothing_is_left_a_chunk_begins_anew(left: Any, plugin: Any) -> None:
    expected = acting(plugin).predict_action_chunk(seen())
    found = acting(plugin).predict_action_chunk(
        seen(), inference_delay=0, prev_chunk_left_over=left
    )
    assert torch.equal(found, expected)


@pytest.mark.parametrize("shape", [(3, 3), (2, 3, 2), (2,)])
def test_what_is_left_of_another_robots_chunk_is_refused(
    shape: tuple[int, ...], plugin: Any
) -> None:
    with pytest.raises(AegisError, match=r"of shape \(.*\n.*\(1, n, 2\)"):
        acting(plugin).predict_action_chunk(seen(), prev_chunk_left_over=torch.ones(shape))


def test_actions_that_are_not_finite_are_refused(plugin: Any) -> None:
    policy = acting(plugin)
    for act in (policy.select_action, policy.predict_action_chunk):
        with pytest.raises(AegisError, match="predicted numbers that are not finite"):
            act(seen(state=torch.full((1, 3), 1e30)))


def test_an_ensemble_is_that_of_load_policy(plugin: Any, tmp_path: Path) -> None:
    """Another text restarts it, and a saved policy keeps it."""
    own = DeployedPolicy(make_policy().eval(), None, (), 2, ensemble=0.1)
    policy = acting(plugin)
    policy.config.n_action_steps, policy.config.temporal_ensemble_coeff = 1, 0.1
    policy.reset()
    for text in (TEXT, TEXT, TEXT, OTHER, OTHER):
        batch = seen(text)
        picture = (batch[IMAGE][0].permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()
        expected = own.select_action(picture, text, batch["observation.state"][0].numpy())
        torch.testing.assert_close(policy.select_action(batch)[0], torch.from_numpy(expected))
    policy._save_pretrained(tmp_path)
    meta = checkpoint.load_policy(tmp_path)[1]
    assert (meta["ensemble"], meta["replan"]) == (0.1, 1)
    policy.config.temporal_ensemble_coeff = None
    policy._save_pretrained(tmp_path)
    assert "ensemble" not in checkpoint.load_policy(tmp_path)[1]


def test_lerobot_trains_by_the_settings_of_aegis_train(plugin: Any) -> None:
    own, recipe = plugin.AegisConfig(), Recipe(name="reach")
    train, expert = recipe.train, recipe.expert
    chunk = (own.chunk_size, own.n_action_steps, own.flow_samples, own.normalization)
    assert chunk == (train.chunk, recipe.rollout.replan, train.flow_samples, train.normalization)
    assert (own.expert_width, own.expert_mlp_ratio) == (expert.width, expert.mlp_ratio)
    assert (own.backbone_lr, own.method) == (train.backbone_lr, train.method)
    adamw = own.get_optimizer_preset()
    assert (adamw.lr, adamw.weight_decay) == (train.expert_lr, train.weight_decay)
    assert adamw.grad_clip_norm == train.clip_norm


@pytest.mark.parametrize("steps", [300, 40_000])
def test_lerobots_learning_rates_are_those_of_aegis_train(steps: int, plugin: Any) -> None:
    """The warm-up is equally long in short and long trainings; the decay ends with the training.

    A long training is compared only at some steps, since a rate depends only on the step.
    """
    peaks = [1e-4, 1e-3]
    groups = [{"params": [nn.Parameter(torch.zeros(1))], "lr": peak} for peak in peaks]
    optimizer = torch.optim.SGD(groups)
    schedule = plugin.AegisConfig().get_scheduler_preset().build(optimizer, steps)
    wanted = Train(steps=steps)
    for step in (*range(300), *range(300, steps, 97), steps - 1):
        if step > 0:
            schedule.last_epoch = step - 1
            optimizer.step()
            schedule.step()
        rates = [group["lr"] for group in optimizer.param_groups]
        assert rates == pytest.approx([peak * rate_factor(step, wanted) for peak in peaks])


def test_a_training_that_is_shorter_than_the_rise_is_warned_of(
    plugin: Any, caplog: pytest.LogCaptureFixture
) -> None:
    scheduler = plugin.AegisConfig(warmup_steps=20).get_scheduler_preset()
    optimizer = torch.optim.SGD([nn.Parameter(torch.zeros(1))])
    scheduler.build(optimizer, 21)
    assert not caplog.records
    scheduler.build(optimizer, 20)
    assert "rise over 20 steps, and the training has 20" in caplog.text


def test_real_time_chunking_of_a_policy_that_averages_is_refused(plugin: Any) -> None:
    policy = acting(plugin)
    policy.config.temporal_ensemble_coeff = 0.01
    with pytest.raises(AegisError, match="0.01 with real-time chunking") as caught:
        policy.supports_rtc()
    assert "--policy.temporal_ensemble_coeff=null" in caught.value.fix


@pytest.mark.parametrize("method", ["kfac", "nullspace"])
def test_a_method_that_protects_asks_for_the_policys_anchor(method: str, plugin: Any) -> None:
    with pytest.raises(AegisError, match=f"{method} without --policy.anchor") as caught:
        plugin.AegisConfig(method=method).get_optimizer_preset()
    assert "--policy.anchor=anchor.safetensors" in caught.value.fix


def test_a_blank_task_is_warned_of_once(plugin: Any, caplog: pytest.LogCaptureFixture) -> None:
    """LeRobot passes an empty text if `lerobot-rollout` has no --task."""
    policy = acting(plugin)
    for _ in range(5):
        policy.select_action(seen(""))
    assert [record.message for record in caplog.records] == [
        "The task is an empty text, which tells a policy nothing: give --task=TEXT"
    ]
    caplog.clear()
    policy.reset()
    policy.select_action(seen())
    assert not caplog.records


def test_a_motor_in_other_units_is_warned_of_once(
    plugin: Any, caplog: pytest.LogCaptureFixture
) -> None:
    model = make_policy().eval()
    policy = plugin.AegisPolicy(config(plugin, model, IMAGE), model=model, meta=NAMED)
    policy.select_action(seen())
    assert not caplog.records
    for _ in range(3):
        policy.select_action(seen(state=torch.tensor([[0.0, -2000.0, 0.0]])))
        policy.reset()
    (record,) = caplog.records
    assert record.message.startswith("The policy was given positions far from those of the train")
    assert "'y' is -2000 (training mean -0.2, standard deviation 0.5)" in record.message


@pytest.mark.parametrize("closes", [True, False])
def test_a_new_policy_knows_how_far_its_motors_ever_were(
    closes: bool, plugin: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(plugin, "_new", lambda *_: make_policy())
    ends = {"min": [-1.0, -2.0, -1.0], "max": [1.0, 30.0 if closes else 2.0, 1.0]}
    statistics = {"observation.state": ends}
    policy = plugin.AegisPolicy(config(plugin, make_policy(), IMAGE), dataset_stats=statistics)
    policy.select_action(seen(state=torch.tensor([[0.0, 30.0, 0.0]])))
    told = [record.levelname for record in caplog.records]
    assert told == ([] if closes else ["WARNING"])
    assert ("proprio_reach" in policy._meta) == closes


def test_where_lerobot_compiles_a_policy_acts_as_without_and_says_so(
    plugin: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """`lerobot-rollout --use_torch_compile`; the picture's processors would not compile."""
    expected, policy = acting(plugin), acting(plugin)
    graphs = list[Any]()

    def backend(graph: Any, _: Any) -> Any:
        graphs.append(graph)
        return graph.forward

    policy.predict_action_chunk = torch.compile(policy.predict_action_chunk, backend=backend)
    with torch.inference_mode():
        for _ in range(4):
            found = policy.select_action(seen())
            torch.testing.assert_close(found, expected.select_action(seen()), rtol=0, atol=0)
    assert not graphs
    said = [record for record in caplog.records if record.name == plugin.__name__]
    assert [record.message for record in said] == [
        "Nothing is compiled: a policy of Aegis acts as without --use_torch_compile"
    ]


def test_a_picture_that_is_missing_is_named_beside_those_that_are_there(plugin: Any) -> None:
    batch = seen()
    batch["observation.images.front"] = batch.pop(IMAGE)
    with pytest.raises(AegisError) as caught:
        acting(plugin).select_action(batch)
    assert caught.value.found == f"no picture {IMAGE}; others are observation.images.front"
    assert f'--rename_map=\'{{"observation.images.NAME": "{IMAGE}"}}\'' in caught.value.fix


def test_a_loaded_policy_says_what_lerobot_does_not_compare_with_a_robot(
    plugin: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """And LeRobot itself knows the names of its actions."""
    names = ["pan.pos", "lift.pos"]
    model, meta = make_policy(), {**NAMED, "action_names": names, "fps": 15.0}
    made = config(plugin, model, IMAGE)
    plugin.AegisPolicy(made, model=model, meta=meta)._save_pretrained(tmp_path)
    with caplog.at_level("INFO"):
        plugin.AegisPolicy.from_pretrained(tmp_path, config=made)
    said = " ".join(record.message for record in caplog.records)
    assert "--fps=15" in said and "in this order: x, y, z" in said
    assert made.action_feature_names == names


def dataset(actions: list[str] | None, fps: int = 30, robot: str | None = None) -> Any:
    """LeRobot's metadata of a dataset, as far as a policy receives it."""
    state = {"dtype": "float32", "shape": (3,), "names": {"motors": ["x", "y", "z"]}}
    action = {"dtype": "float32", "shape": (2,), "names": actions}
    features = {"observation.state": state, "action": action}
    return SimpleNamespace(fps=fps, robot_type=robot, features=features)


def test_a_new_policy_keeps_what_the_dataset_says_of_the_robot(
    plugin: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """So that a robot's observation can be told, as with a policy of `aegis train`."""
    monkeypatch.setattr(plugin, "_new", lambda *_: make_policy())
    made = config(plugin, make_policy(), IMAGE)
    told = dataset(["x", "y"], robot="aegis/reach")
    plugin.AegisPolicy(made, {}, dataset_meta=told)._save_pretrained(tmp_path)
    meta = checkpoint.load_policy(tmp_path)[1]
    names = (meta["proprio_names"], meta["action_names"])
    assert names == (["x", "y", "z"], ["x", "y"])
    assert (meta["fps"], meta["task"]) == (30.0, "reach")
    nameless = plugin.AegisPolicy(made, {}, dataset_meta=dataset(None))
    assert "action_names" not in nameless._meta and nameless._meta["task"] is None


def test_a_policy_goes_on_with_its_own_joints_alone(
    plugin: Any, caplog: pytest.LogCaptureFixture
) -> None:
    known = {"action_names": ["x", "y"], "fps": 30.0}
    for same in (["x", "y"], None):
        plugin._check_recorded(known, plugin._recorded(dataset(same)))
    assert not caplog.records
    with pytest.raises(AegisError, match="'x' in another place.*actions y, x"):
        plugin._check_recorded(known, plugin._recorded(dataset(["y", "x"])))
    plugin._check_recorded(known, plugin._recorded(dataset(["pan", "tilt"], fps=10)))
    said = [record.message for record in caplog.records]
    assert "the actions pan, tilt, and the policy x, y" in said[0]
    assert "30 frames a second, and the dataset has 10" in said[1]


def test_an_ensemble_predicts_at_every_step(plugin: Any) -> None:
    made = plugin.AegisConfig(temporal_ensemble_coeff=0.01, n_action_steps=1)
    assert made.temporal_ensemble_coeff == 0.01
    with pytest.raises(AegisError, match=r"0\.01 with n_action_steps 4"):
        plugin.AegisConfig(temporal_ensemble_coeff=0.01)
    with pytest.raises(AegisError, match="decay nan"):
        plugin.AegisConfig(temporal_ensemble_coeff=math.nan, n_action_steps=1)
