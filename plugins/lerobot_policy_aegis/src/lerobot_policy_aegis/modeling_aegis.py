"""An Aegis policy with LeRobot's interface: batches of tensors in, actions or a loss out."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from huggingface_hub import snapshot_download
from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from aegis_cli import methods
from aegis_cli.common.errors import AegisError
from aegis_cli.common.pictures import fit
from aegis_cli.core.continuation import Continued
from aegis_cli.core.ensemble import TemporalEnsemble
from aegis_cli.data import far_positions, joints
from aegis_cli.data.batch import Images, Normalizer, RobotBatch, least_spread
from aegis_cli.data.far_positions import FarPositions
from aegis_cli.data.lerobot import layout
from aegis_cli.models import backbones, lerobot_folder
from aegis_cli.models.expert import ActionExpert, ExpertShape
from aegis_cli.models.policy import Policy, check_actions
from aegis_cli.training import checkpoint
from lerobot_policy_aegis.configuration_aegis import AegisConfig

TASK, IS_PAD, INDEX = "task", "action_is_pad", "index"
OBSERVED = "observation."  # prefix of LeRobot's full names
Statistics = Mapping[str, Mapping[str, Any]]
_LOG = logging.getLogger(__name__)


class AegisPolicy(PreTrainedPolicy):
    """`aegis_cli.models.policy.Policy` behind LeRobot's interface.

    Attributes:
        model: the policy itself; it takes and returns raw values.
    """

    config_class = AegisConfig
    name = "aegis"

    def __init__(
        self,
        config: AegisConfig,
        dataset_stats: Statistics | None = None,
        model: Policy | None = None,
        meta: Mapping[str, Any] | None = None,
        dataset_meta: Any = None,
        **_: Any,
    ) -> None:
        """Wrap a policy, or create a new one.

        Args:
            config: with the features.
            dataset_stats: statistics by which a new policy is scaled.
            model: a loaded policy; None for a new one, with the backbone that the config names.
            meta: what the user of a loaded policy has to know.
            dataset_meta: LeRobot's metadata of the dataset; a new policy takes the names of joints
                and the control rate from it.

        Raises:
            AegisError: the features are not those of the policy, or a new policy has no statistics.
        """
        super().__init__(config)
        config.validate_features()
        self.config: AegisConfig = config
        self.model = model or _new(config, dataset_stats)
        known = {"task": None, "normalization": config.normalization, **_recorded(dataset_meta)}
        self._meta = dict(meta or known)
        if model is None and (spread := _spread(dataset_stats, ACTION)) is not None:
            self._meta["action_std"] = spread.tolist()
        if model is None and (ends := _ends(dataset_stats, OBS_STATE)) is not None:
            reach = far_positions.reach(ends, self.model.proprio_scale, config.normalization)
            self._meta |= {} if reach is None else {"proprio_reach": reach}
        self._cameras = self._in_order()
        if model is None and self.model.backbone.image_size is None:
            features = config.image_features
            self._meta["pictures"] = [list(features[name].shape[1:]) for name in self._cameras]
        sizes = checkpoint.sizes_of(self._meta)
        self._sizes = dict(zip(self._cameras, sizes, strict=True)) if sizes else {}
        _check_sizes(config, self.model)
        _check_cameras(self._cameras, self.model)
        chosen = methods.get(config.method)
        chosen.adapt(self.model.backbone, self.model.backbone.language_maps(), {})
        # LeRobot's programs for robots use these names for a policy's actions, if they need any.
        config.action_feature_names = self._meta.get("action_names")
        self._is_told_of_compiling = False
        self._far = FarPositions(
            self.model.proprio_scale,
            self._meta.get("proprio_names"),
            self._meta.get("normalization", "mean_std"),
            self._meta.get("proprio_reach"),
        )
        self._generator = torch.Generator()
        self.reset()

    # --- acting -----------------------------------------------------------------------------------

    def reset(self) -> None:
        """Begin episodes: forget the last prediction, and restart the flow's noise."""
        self._ahead: deque[Tensor] = deque()
        decay = self.config.temporal_ensemble_coeff
        self._averaged = None if decay is None else TemporalEnsemble(decay)
        self._is_told = False  # whether a warning about an empty text was given in this episode
        self._follow: list[str] = []  # the texts that the pending actions were predicted for
        self._generator.manual_seed(self.config.noise_seed)

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """The next action of each row [B, A]; every `n_action_steps`-th call predicts a chunk.

        With a temporal ensemble every call predicts, and the action is the weighted mean of the
        predictions so far for this step. If the texts change, a new chunk is predicted at once and
        the rest of the old one is dropped.

        Raises:
            AegisError: the texts or the state are invalid, as in `predict_action_chunk`, or a
                picture is not finite. This is checked at every call, so that a robot whose sensor
                fails does not continue with an older prediction.
        """
        texts = _texts(batch)
        self._state(batch, len(texts))
        for name in self._cameras:
            if name in batch:
                _check_picture(name, batch[name])
        if texts != self._follow:
            self._ahead.clear()
            if self._averaged is not None:
                self._averaged.reset()
        if self._averaged is not None:
            action = self._averaged.next(self.predict_action_chunk(batch, **kwargs))
            self._follow = texts
            return action
        if not self._ahead:
            chunk = self.predict_action_chunk(batch, **kwargs)
            self._ahead.extend(chunk[:, : self.config.n_action_steps].unbind(1))
            self._follow = texts
        return self._ahead.popleft()

    def supports_rtc(self) -> bool:
        """True: LeRobot's real-time chunking (`--inference.type=rtc`) is supported.

        It asks for chunks that continue each other.

        Raises:
            AegisError: the policy averages chunks, which is not possible with such chunks.
        """
        decay = self.config.temporal_ensemble_coeff
        if decay is not None:
            raise AegisError(
                f"temporal_ensemble_coeff {decay:g} with real-time chunking",
                "one of the two: chunks that continue each other are not averaged",
                "--policy.temporal_ensemble_coeff=null, or --inference.type=sync",
            )
        return True

    @torch.compiler.disable  # the backbones' processors for pictures and texts do not compile
    @torch.no_grad()
    def predict_action_chunk(
        self,
        batch: dict[str, Any],
        noise: Tensor | None = None,
        inference_delay: int | None = None,
        prev_chunk_left_over: Tensor | None = None,
    ) -> Tensor:
        """The next actions of each row, [B, H, A] in raw units.

        Args:
            batch: pictures [B, 3, H, W] in [0, 1], `observation.state` [B, P] and B texts `task`.
            noise: must be None; the policy draws its own, from `noise_seed`.
            inference_delay: how many of the remaining actions are executed before the new ones
                arrive; None: none.
            prev_chunk_left_over: the rest of the previous chunk [n, A] or [B, n, A], which the new
                one continues (`aegis_cli.core.continuation`); None: it starts afresh.

        Raises:
            AegisError: the policy cannot act on the pictures, texts or state, the previous actions
                have other sizes, or predicted actions are not finite.
        """
        if noise is not None:
            raise AegisError("noise that was drawn elsewhere", "none", "set policy.noise_seed")
        self.eval()
        self._warn_of_compiling()
        images, texts = self._images(batch), _texts(batch)
        self._warn_of_no_task(texts)
        state = self._state(batch, len(texts))
        continued = self._continued(prev_chunk_left_over, inference_delay or 0, len(texts))
        return check_actions(self.model.act(images, texts, state, self._generator, continued))

    def _warn_of_compiling(self) -> None:
        """Warn once that `--use_torch_compile` has no effect; LeRobot replaces a method for it."""
        if "predict_action_chunk" in vars(self) and not self._is_told_of_compiling:
            self._is_told_of_compiling = True
            _LOG.warning(
                "Nothing is compiled: a policy of Aegis acts as without --use_torch_compile"
            )

    def _warn_of_no_task(self, texts: Sequence[str]) -> None:
        """Warn once per episode of a blank text, as LeRobot passes if `--task` is left out."""
        if self._is_told or all(text.strip() for text in texts):
            return
        self._is_told = True
        _LOG.warning("The task is an empty text, which tells a policy nothing: give --task=TEXT")

    def _continued(self, left: Tensor | None, delay: int, rows: int) -> Continued | None:
        """The chunk to continue, from LeRobot's arguments; None if nothing of it is left.

        Raises:
            AegisError: the actions have other sizes.
        """
        if left is None:
            return None
        actions = left.float() if left.ndim == 3 else left.float()[None]
        if actions.ndim != 3 or actions.shape[0] != rows or actions.shape[2] != self._actions:
            raise AegisError(
                f"what is left of a chunk of shape {tuple(left.shape)}",
                f"({rows}, n, {self._actions})",
                "give the actions as the policy predicted them",
            )
        # LeRobot pads a rest shorter than --inference.rtc.execution_horizon, in some versions with
        # zeros, in others with the last action, which cannot be distinguished from a real one.
        given = actions.abs().amax((0, 2)).nonzero()
        count = int(given[-1]) + 1 if len(given) else 0
        actions = actions[:, : min(count, self.config.chunk_size)]
        return Continued(actions, min(delay, actions.shape[1])) if actions.shape[1] else None

    @property
    def _actions(self) -> int:
        return len(self.model.action_scale.mean)

    @torch.no_grad()
    def generate_text(
        self, batch: dict[str, Any], questions: Sequence[str] | None = None
    ) -> list[str]:
        """The answers of the policy's own VLM to one question per row.

        Args:
            batch: as for `predict_action_chunk`; the first camera's pictures are asked about.
            questions: B texts; None: the batch's `task`.
        """
        self.eval()
        asked = _texts(batch) if questions is None else list(questions)
        pictures = self._pictures(batch, self._cameras[0])
        return self.model.backbone.answer(torch.stack(pictures), asked)

    # --- learning ---------------------------------------------------------------------------------

    def forward(
        self, batch: dict[str, Any], reduction: str = "mean"
    ) -> tuple[Tensor, dict[str, float]]:
        """The flow-matching loss of a batch of frames with their chunks of actions [B, H, A].

        The noise is a function of the seed and the frames, so that a resumed run draws the same as
        an uninterrupted one; LeRobot's own generator does not return to the same state.
        """
        if reduction != "mean":
            raise AegisError(
                f"a loss with reduction '{reduction}'", "the mean", "train without sample weights"
            )
        images, texts = self._images(batch), _texts(batch)
        actions = batch[ACTION].float()
        is_pad = batch.get(IS_PAD)
        if is_pad is None:
            is_pad = torch.zeros(actions.shape[:2], dtype=torch.bool)
        frames = RobotBatch(images, texts, batch[OBS_STATE].float(), actions, is_pad)
        generator = torch.Generator().manual_seed(self._seed_of(batch))
        detach = methods.get(self.config.method).stop_gradient
        with torch.set_grad_enabled(torch.is_grad_enabled() and not detach):
            encoding = self.model.encode(images, texts)
        loss = self.model.flow_loss(frames, encoding, self.config.flow_samples, generator, detach)
        return loss, {"flow_loss": loss.item()}

    def _seed_of(self, batch: Mapping[str, Any]) -> int:
        """A seed from the indices of the frames in their dataset, if they have any."""
        if (index := batch.get(INDEX)) is None:
            return int(torch.randint(2**62, ()))
        numbers = [self.config.noise_seed, *index.flatten().tolist()]
        return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0] >> np.uint64(1))

    def get_optim_params(self) -> list[dict[str, Any]]:
        """Parameter groups of backbone and expert, each with its own learning rate."""
        parts = (
            (self.model.backbone, self.config.backbone_lr),
            (self.model.expert, self.config.expert_lr),
        )
        groups = []
        for module, rate in parts:
            if learning := [p for p in module.parameters() if p.requires_grad]:
                groups.append({"params": learning, "lr": rate})
        return groups

    # --- files ------------------------------------------------------------------------------------

    def _save_pretrained(
        self, save_directory: Path, state_dict: dict[str, Tensor] | None = None
    ) -> None:
        """Write LeRobot's configuration, and the policy as `aegis export` does."""
        if state_dict is not None:
            raise AegisError(
                "weights that were gathered from several processes",
                "a policy that is whole in every process",
                "train without FSDP",
            )
        self.config._save_pretrained(save_directory)
        known = {name: value for name, value in self._meta.items() if name != "ensemble"}
        if self.config.temporal_ensemble_coeff is not None:
            known["ensemble"] = self.config.temporal_ensemble_coeff
        meta = {
            "method": self.config.method,
            "replan": self.config.n_action_steps,
            "cameras": [_short(name) for name in self._cameras],
        }
        lerobot_folder.write_model(Path(save_directory), self.model, {**known, **meta})

    @classmethod
    def from_pretrained(
        cls,
        pretrained_name_or_path: str | Path,
        *,
        config: PreTrainedConfig | None = None,
        force_download: bool = False,
        resume_download: bool | None = None,
        proxies: dict | None = None,
        token: str | bool | None = None,
        cache_dir: str | Path | None = None,
        local_files_only: bool = False,
        revision: str | None = None,
        strict: bool = True,
        **kwargs: Any,
    ) -> AegisPolicy:
        """Load the policy in a folder or with an id on the hub; always strict.

        Args:
            strict: ignored; loading is always strict.
            kwargs: further arguments from LeRobot; the statistics of a dataset do not change the
                scales of a trained policy, and its joints must be those of the policy.

        Raises:
            AegisError: a file or tensor is missing, damaged or unexpected, or the joints of the
                dataset are in another order than those of the policy.
        """
        folder = Path(pretrained_name_or_path)
        if not folder.is_dir():
            folder = Path(
                snapshot_download(
                    str(pretrained_name_or_path),
                    revision=revision,
                    cache_dir=cache_dir,
                    force_download=force_download,
                    token=token,
                    local_files_only=local_files_only,
                )
            )
        if config is None:
            config = PreTrainedConfig.from_pretrained(folder)
        if not lerobot_folder.is_policy(folder):
            raise AegisError(
                f"no policy of Aegis in '{folder}'",
                f"{lerobot_folder.CONFIG} of type aegis, and {lerobot_folder.MODEL}",
                "aegis export RUN --format lerobot --out FOLDER",
            )
        model, meta = checkpoint.load_policy(folder)
        _check_recorded(meta, _recorded(kwargs.get("dataset_meta")))
        policy = cls(config, model=model, meta=meta)
        policy.to(config.device)
        _say_what_robot(meta)
        return policy.eval()

    # --- batches ----------------------------------------------------------------------------------

    def _in_order(self) -> list[str]:
        """Names of the pictures, in the order that the backbone expects."""
        named = self._meta.get("cameras")
        given = list(self.config.image_features)
        if not named:
            return given
        keys = [_key(name, given) for name in named]
        if set(keys) != set(given):
            raise AegisError(
                f"pictures {', '.join(given)}", ", ".join(keys), "use the names of training"
            )
        return keys

    def _state(self, batch: Mapping[str, Any], rows: int) -> Tensor:
        """The positions [B, P] of `rows` robots; warns once of each that is far from training.

        Raises:
            AegisError: they are missing, have another shape, or are not finite.
        """
        wanted, found = (rows, len(self.model.proprio_scale.mean)), batch.get(OBS_STATE)
        if found is None or tuple(found.shape) != wanted:
            said = "none" if found is None else f"of shape {tuple(found.shape)}"
            names = ", ".join(self._meta.get("proprio_names") or ())
            raise AegisError(
                f"{OBS_STATE} {said} in a batch of {rows}",
                f"{wanted}: {names}" if names else f"{wanted}",
                "give what the demonstrations hold, a row per text",
            )
        if not found.isfinite().all():
            raise AegisError(
                f"an {OBS_STATE} that is not finite: {found.tolist()}",
                "finite numbers",
                "check the robot's sensors",
            )
        state = found.float()
        if (far := self._far.notice(state.cpu().numpy())) is not None:
            _LOG.warning("The policy was given %s", far)
        return state

    def _images(self, batch: Mapping[str, Any]) -> Images:
        missing = [name for name in self._cameras if name not in batch]
        if missing:
            others = [name for name in batch if "image" in name and name not in self._cameras]
            raise AegisError(
                f"no picture {', '.join(missing)}; others are {', '.join(others) or 'not there'}",
                f"the pictures {', '.join(self._cameras)}",
                "give all of them; of a camera that has another name: "
                f'--rename_map=\'{{"{lerobot_folder.IMAGES}NAME": "{missing[0]}"}}\'',
            )
        pictures = [self._pictures(batch, name) for name in self._cameras]
        if len(pictures) == 1:
            return torch.stack(pictures[0])
        return list(zip(*pictures, strict=True))

    def _pictures(self, batch: Mapping[str, Any], name: str) -> list[Tensor]:
        """B pictures [H, W, 3] uint8 of one camera, in the size used in training.

        Raises:
            AegisError: values are not finite, so they have no byte value.
        """
        found = batch[name]
        if found.is_floating_point():
            _check_picture(name, found)
            found = (found * 255).round().clamp(0, 255).to(torch.uint8)
        rows = found.permute(0, 2, 3, 1).cpu().contiguous()
        side = self.model.backbone.image_size
        size = self._sizes.get(name) if side is None else (side, side)
        if size is None or rows.shape[1:3] == size:
            return list(rows)
        fitted = [fit(row.numpy(), *size) for row in rows]
        return [torch.from_numpy(np.ascontiguousarray(row)) for row in fitted]


def _check_picture(name: str, found: Tensor) -> None:
    """Raise AegisError for a picture with values that are not finite: they have no byte value."""
    if bad := int((~found.isfinite()).sum()):
        raise AegisError(
            f"a picture {name} with {bad:,} values that are not finite",
            "numbers from 0 to 1",
            "check that the camera delivered a frame",
        )


def _texts(batch: Mapping[str, Any]) -> list[str]:
    texts = batch.get(TASK)
    if isinstance(texts, str) or not texts:
        raise AegisError(
            f"a batch whose '{TASK}' is {texts!r}",
            "a text per row",
            "use a dataset with tasks, or an environment with a task_description",
        )
    return list(texts)


def _short(name: str) -> str:
    """A picture's name as it is saved; a name such as `observation.image` is saved in full."""
    return name.removeprefix(lerobot_folder.IMAGES)


def _key(name: str, given: Sequence[str]) -> str:
    """LeRobot's name of the picture that was saved as `name`."""
    key = f"{lerobot_folder.IMAGES}{name}"
    # `aegis export` once put the prefix before full names too, and such policies still load.
    return name if name.startswith(OBSERVED) and key not in given else key


def _new(config: AegisConfig, statistics: Statistics | None) -> Policy:
    """A new policy: a pre-trained backbone and an untrained action expert."""
    if statistics is None:
        raise AegisError(
            "a new policy without the statistics of a dataset",
            "a dataset, whose statistics scale what goes in and comes out",
            "train it, or load one: --policy.path=FOLDER",
        )
    backbone = backbones.load(config.backbone)
    scales = [_scale(statistics, name, config.normalization) for name in (OBS_STATE, ACTION)]
    shape = ExpertShape(
        depth=backbone.depth,
        heads=backbone.heads,
        head_dim=backbone.head_dim,
        proprio=len(scales[0].mean),
        actions=len(scales[1].mean),
        chunk=config.chunk_size,
        width=config.expert_width,
        mlp_ratio=config.expert_mlp_ratio,
        kv_heads=backbone.kv_heads if backbone.kv_heads != backbone.heads else None,
    )
    return Policy(backbone, ActionExpert(shape), *scales)


def _recorded(dataset_meta: Any) -> dict[str, Any]:
    """A LeRobot dataset's facts about its robot, as in checkpoints of `aegis train`."""
    if dataset_meta is None:
        return {}
    found: dict[str, Any] = {"fps": float(dataset_meta.fps)}
    if (task := layout.simulated_task(dataset_meta.robot_type)) is not None:
        found["task"] = task
    for kind, feature in (("proprio_names", OBS_STATE), ("action_names", ACTION)):
        said = dataset_meta.features[feature]
        names = layout.Feature(said["dtype"], tuple(said["shape"]), said["names"], False).components
        if all(names):
            found[kind] = list(names)
    return found


def _say_what_robot(known: Mapping[str, Any]) -> None:
    """Log what LeRobot does not check against a robot: the control rate and the order of joints."""
    if (fps := known.get("fps")) is not None:
        _LOG.info("Trained at %g actions a second; a robot does as many with --fps=%g", fps, fps)
    if names := known.get("proprio_names"):
        _LOG.info("Trained on these positions, in this order: %s", ", ".join(names))


def _check_recorded(known: Mapping[str, Any], found: Mapping[str, Any]) -> None:
    """Warn if a dataset names joints differently from the policy, or has another control rate.

    Raises:
        AegisError: a joint is in another place.
    """
    for other in joints.differences(known, found):
        if other.moved is not None:
            raise AegisError(
                f"'{other.moved}' in another place than the policy has it, in a dataset with the "
                f"{other.what} {', '.join(other.found)}",
                f"{', '.join(other.known)}, in this order, as it was trained on",
                "give a dataset in that order, or train a new policy: --policy.type=aegis",
            )
        _LOG.warning(
            "The dataset calls the %s %s, and the policy %s: see that they are the same.",
            other.what,
            ", ".join(other.found),
            ", ".join(other.known),
        )
    before, now = known.get("fps"), found.get("fps")
    if before is not None and now is not None and before != now:
        _LOG.warning(
            "The policy was trained on %g frames a second, and the dataset has %g: the policy's "
            "actions are meant for steps of another length.",
            before,
            now,
        )


def _scale(statistics: Statistics, name: str, normalization: str) -> Normalizer:
    names = ("mean", "std") if normalization == "mean_std" else ("q01", "q99")
    found = [statistics.get(name, {}).get(each) for each in names]
    if any(values is None for values in found):
        raise AegisError(
            f"statistics of {name} without {' and '.join(names)}",
            f"those that normalization {normalization} needs",
            "--policy.normalization=mean_std, or compute the dataset's statistics anew",
        )
    first, second = map(_numbers, found)
    middle, scale = first, second
    if normalization != "mean_std":
        middle, scale = (first + second) / 2, (second - first) / 2
    return Normalizer.scaled(middle, scale, _never_varies(statistics.get(name, {})))


def _numbers(values: Any) -> Tensor:
    return torch.as_tensor(np.asarray(values)).double().flatten()


def _never_varies(of: Mapping[str, Any]) -> Tensor | None:
    """Which components [D] of a feature are constant in the dataset; None if it does not tell."""
    if any(of.get(name) is None for name in ("min", "max", "mean")):
        return None
    low, high, mean = (_numbers(of[name]) for name in ("min", "max", "mean"))
    return high - low <= least_spread(mean)


def _ends(statistics: Statistics | None, name: str) -> Tensor | None:
    """The minima and maxima [2, D] of a feature; None if unknown."""
    of = (statistics or {}).get(name, {})
    if any(of.get(end) is None for end in ("min", "max")):
        return None
    return torch.stack([_numbers(of[end]) for end in ("min", "max")]).float()


def _spread(statistics: Statistics | None, name: str) -> Tensor | None:
    """The standard deviations [D] of a feature, 0 where it is constant; None if unknown."""
    of = (statistics or {}).get(name, {})
    if of.get("std") is None:
        return None
    spread, still = _numbers(of["std"]), _never_varies(of)
    return spread if still is None else torch.where(still, 0.0, spread)


def _check_sizes(config: AegisConfig, model: Policy) -> None:
    sizes = {
        OBS_STATE: (config.robot_state_feature.shape, len(model.proprio_scale.mean)),
        ACTION: (config.action_feature.shape, len(model.action_scale.mean)),
        "chunk_size": ((config.chunk_size,), model.expert.shape.chunk),
    }
    for name, (given, own) in sizes.items():
        if tuple(given) != (own,):
            raise AegisError(
                f"{name} {tuple(given)} for a policy of {own}",
                "what it was trained on",
                "use its own robot's dataset or environment",
            )


def _check_cameras(cameras: Sequence[str], model: Policy) -> None:
    if len(cameras) > 1 and not model.backbone.reads_several:
        raise AegisError(
            f"pictures {', '.join(cameras)} with a backbone that reads one",
            "one camera, or a Hugging Face backbone",
            "leave the others out of the dataset's or the policy's features",
        )
