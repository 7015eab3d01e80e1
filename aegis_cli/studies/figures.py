"""The results of a study's cells: the figures of one training, as stored in `cells.json`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace


@dataclass(frozen=True)
class VqaFigures:
    """Figures of a policy on one question set: the fields of `PolicyFigures` that depend on it.

    Units are the same.
    """

    accuracy: float
    drop_points: float
    drop_interval: tuple[float, float]
    cross_entropy: float
    w2: float | None
    baseline_accuracy: float
    baseline_cross_entropy: float
    majority_accuracy: float
    lost_per_image: tuple[int, ...] | None = None
    questions_per_image: tuple[int, ...] | None = None
    images: tuple[str, ...] | None = None


@dataclass(frozen=True)
class PolicyFigures:
    """The figures of one trained policy.

    Shares in [0, 1], `drop_points` in percentage points, cross-entropy in nats, W2^2 as a mean over
    layers; `wrong_target` is on the seen colours. The baseline is the backbone before training,
    asked the same questions. A task that is measured by its return has `return_share` instead of
    successes (1 is the highest possible return). If several question sets are asked, the VQA
    figures are those of the first set, and `others` has those of each further set by its name.

    The values per image and episode are stored too, if they are known, so that intervals can be
    computed over seeds, images and episodes. Cells with equal `probe_seed` were asked the same
    questions; cells with equal `rollout_seed` played the same episodes.

    Attributes:
        lost_per_image: for each image, correct answers before training minus those after it.
        questions_per_image: for each image, the number of its questions.
        images: a digest of each image's name, if other seeds may have been asked about the same
            images; None for scenes.
        outcomes_seen, outcomes_held_out: one character per episode, 1 for a success, else 0.
        open_loop_error: for a policy that cannot be rolled out, the squared error of its actions on
            held-out episodes over their variance in training (1 is the error of always predicting
            the mean action); a mean if there are several data sets.
        hold_error: the same for a robot that holds its position, if actions are positions.
        evaluated_episodes: the held-out episodes as `SET/NUMBER`, where SET counts the data sets
            from 1.
        weight_per_episode: the weight of each episode in these errors; they sum to 1.
        error_per_episode, hold_per_episode: the errors in each episode.
        code: version and digest of the package that measured the cell.
    """

    method: str
    accuracy: float
    drop_points: float
    drop_interval: tuple[float, float]
    cross_entropy: float
    success_seen: float | None
    success_held_out: float | None
    wrong_target: float | None
    w2: float | None
    energy_shed: float | None
    step_s: float
    step_time_ratio: float | None
    validation_loss: float
    baseline_accuracy: float
    baseline_cross_entropy: float
    majority_accuracy: float
    return_share: float | None = None
    open_loop_error: float | None = None
    hold_error: float | None = None
    evaluated_episodes: tuple[str, ...] | None = None
    weight_per_episode: tuple[float, ...] | None = None
    error_per_episode: tuple[float, ...] | None = None
    hold_per_episode: tuple[float, ...] | None = None
    lost_per_image: tuple[int, ...] | None = None
    questions_per_image: tuple[int, ...] | None = None
    images: tuple[str, ...] | None = None
    probe_seed: int = 0
    outcomes_seen: str | None = None
    outcomes_held_out: str | None = None
    rollout_seed: int = 0
    code: str | None = None
    others: dict[str, VqaFigures] = field(default_factory=dict)

    def asked(self, vqa: str) -> PolicyFigures:
        """The same policy with the figures of the question set `vqa`."""
        other = self.others.get(vqa)
        return self if other is None else replace(self, **vars(other))


@dataclass(frozen=True)
class StreamFigures:
    """The figures of one learned stream.

    Shares in [0, 1]. Transfer, Average, Last and forgetting are with the task told, and inferred.
    `parameters` counts the numbers stored beside the bare encoder at the end, of which
    `inference_parameters` are used to infer the task. `trained_` figures are means over tasks of
    the parameters that learned: in phase 1, in the last phase, and over all steps.

    Attributes:
        own: accuracy on each task right after it was learned, with the task told.
        added: numbers stored since the previous task, for each task.
        new_experts: experts in all maps that belong to the task, for each task.
        first_change: change of the first task's accuracy, with the task told, from right after it
            was learned to the end.
        minutes: time of training and evaluation.
    """

    method: str
    transfer: float | None
    average: float
    last: float
    forgetting: float | None
    inferred_transfer: float | None
    inferred_average: float
    inferred_last: float
    inferred_forgetting: float | None
    reuse: float | None
    parameters: int
    inference_parameters: int
    trained_phase1: float | None
    trained: float
    trained_mean: float
    own: tuple[float, ...]
    added: tuple[int, ...]
    new_experts: tuple[int, ...]
    first_change: float
    minutes: float


@dataclass(frozen=True)
class RobotStreamFigures:
    """The figures of one learned stream of robot tasks.

    Shares in [0, 1]; Average, Last and forgetting are of success, with the task told.

    Attributes:
        success: row t with t + 1 entries: success on each task so far after task t.
        vqa: VQA accuracy with no task active, before the first task and after each; `cross_entropy`
            in nats likewise.
        parameters: numbers stored beside the bare backbone at the end.
        trained_mean: parameters that learned, mean over all steps and tasks.
        reuse: routing mass on experts of earlier tasks; None without experts, or with one task.
        minutes: time of training and evaluation.
        code: version and digest of the package that measured the cell.
    """

    method: str
    success: tuple[tuple[float, ...], ...]
    average: float
    last: float
    forgetting: float | None
    vqa: tuple[float, ...]
    cross_entropy: tuple[float, ...]
    parameters: int
    trained_mean: float
    reuse: float | None
    minutes: float
    code: str | None = None


@dataclass(frozen=True)
class Divergence:
    """A training that met a number that is not finite, after `good_steps` good steps.

    It has no measurements.
    """

    good_steps: int


Figures = PolicyFigures | StreamFigures | RobotStreamFigures
Outcome = Figures | Divergence
