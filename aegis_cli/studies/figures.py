"""What a study's cells lead to: the figures of one training, as `cells.json` stores them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace


@dataclass(frozen=True)
class VqaFigures:
    """What one set of questions tells of a policy: the fields of `PolicyFigures` that depend on it.

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
    """One policy, trained once.

    Shares in [0, 1], `drop_points` in percentage points, cross-entropy in nats, W2^2 as a mean over
    layers; `wrong_target` is on the seen colours. The baseline is the backbone before training,
    asked the same questions. A task that is measured by its return has `return_share` instead of
    successes: 1 is the highest return there is. Where several sets of questions are asked, the
    figures of VQA are those of the first, and `others` has those of each further set by its name.

    What the figures are means of is kept too, where it is known, so that intervals can be drawn
    over seeds, images and episodes. Cells of one `probe_seed` were asked the same questions, those
    of one `rollout_seed` played the same episodes.

    Attributes:
        lost_per_image: for each image, correct answers before training minus those after it.
        questions_per_image: for each image, the number of its questions.
        images: a digest of each image's name, where other seeds may have been asked about the same
            ones; None of scenes.
        outcomes_seen, outcomes_held_out: one character per episode, 1 for a success, else 0.
        open_loop_error: of a policy that cannot be rolled out: the squared error of its actions on
            held-out episodes over their variance in training; 1 is that of always the mean action.
            Of several data sets, the mean of theirs.
        hold_error: the same of a robot that holds its position, where actions are positions.
        evaluated_episodes: the held-out episodes, each `SET/NUMBER` with the data set's place among
            several, from 1.
        weight_per_episode: the share that each has in these errors; together 1.
        error_per_episode, hold_per_episode: the errors in each.
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
        """The same policy by the figures of one of its sets of questions."""
        other = self.others.get(vqa)
        return self if other is None else replace(self, **vars(other))


@dataclass(frozen=True)
class StreamFigures:
    """One stream, learned once.

    Shares in [0, 1]. Transfer, Average, Last and forgetting are with the task told, and inferred.
    `parameters` are the numbers stored beside the bare encoder at the end, `inference_parameters`
    of them tell the task; `trained_` figures are means over tasks of the parameters that learned:
    in phase 1, in the last phase, and over all steps.

    Attributes:
        own: accuracy on each task, told, right after it was learned.
        added: numbers stored since the task before, for each task.
        new_experts: experts in all maps that belong to the task, for each task.
        first_change: change of the first task's accuracy, told, from its own learning to the end.
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
    """One stream of robot tasks, learned once.

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
    """A training that met a number that is not finite, after so many good steps.

    Nothing of it is measured.
    """

    good_steps: int


Figures = PolicyFigures | StreamFigures | RobotStreamFigures
Outcome = Figures | Divergence
