"""Names, sets, instructions and facts of MetaWorld's tasks; needs neither MetaWorld nor MuJoCo."""

from __future__ import annotations

from dataclasses import replace

from aegis_cli.sim.contract import METAWORLD, TaskSpec

CAMERA = "corner2"
# All cameras of the benchmark, the usual one first.
CAMERAS = (CAMERA, "corner", "corner3", "topview", "behindGripper", "gripperPOV")

# The instructions of each task, in our own words; each episode has one of them. `embedded-easy`
# knows all their words, so that it can be trained on every task.
SENTENCES: dict[str, tuple[str, ...]] = {
    "assembly": ("put the nut on the peg", "pick up the nut and place it on the peg"),
    "basketball": ("put the ball into the basket", "dunk the basketball"),
    "bin-picking": ("move the puck to the other bin", "take the puck and drop it in the other bin"),
    "box-close": ("close the box", "put the lid on the box"),
    "button-press-topdown": ("press the button from above", "push the button down"),
    "button-press-topdown-wall": (
        "press the button behind the wall from above",
        "reach over the wall and push the button down",
    ),
    "button-press": (
        "press the button",
        "push the button into the wall",
        "press the red button in front of you",
    ),
    "button-press-wall": ("press the button behind the wall", "go around the wall to the button"),
    "coffee-button": ("press the button of the coffee machine", "start the coffee machine"),
    "coffee-pull": ("pull the mug away from the coffee machine", "take the mug from the machine"),
    "coffee-push": ("push the mug under the coffee machine", "slide the mug to the machine"),
    "dial-turn": ("turn the dial", "rotate the dial"),
    "disassemble": ("take the nut off the peg", "lift the nut from the peg"),
    "door-close": ("close the door", "push the door shut"),
    "door-lock": ("lock the door", "turn the lock until the door is locked"),
    "door-open": (
        "open the door",
        "pull the door open",
        "take the handle and open the door",
    ),
    "door-unlock": ("unlock the door", "turn the lock until the door is unlocked"),
    "hand-insert": ("put the gripper into the hole", "insert the hand into the hole"),
    "drawer-close": ("close the drawer", "push the drawer shut"),
    "drawer-open": (
        "open the drawer",
        "pull the drawer open",
        "pull the handle of the drawer",
    ),
    "faucet-open": ("open the faucet", "turn the faucet on"),
    "faucet-close": ("close the faucet", "turn the faucet off"),
    "hammer": ("hammer the nail into the wall", "hit the nail with the hammer"),
    "handle-press-side": ("press the handle at the side down", "push the side handle down"),
    "handle-press": ("press the handle down", "push the handle down"),
    "handle-pull-side": ("pull the handle at the side up", "lift the side handle"),
    "handle-pull": ("pull the handle up", "lift the handle"),
    "lever-pull": ("pull the lever up", "lift the lever"),
    "pick-place-wall": (
        "lift the puck over the wall to the goal",
        "pick up the puck and place it behind the wall",
    ),
    "pick-out-of-hole": ("take the puck out of the hole", "lift the puck out of the hole"),
    "pick-place": ("pick up the puck and place it at the goal", "lift the puck to the goal"),
    "plate-slide": ("slide the plate into the cabinet", "push the plate into the cabinet"),
    "plate-slide-side": (
        "slide the plate sideways into the cabinet",
        "push the plate sideways into the cabinet",
    ),
    "plate-slide-back": ("slide the plate out of the cabinet", "pull the plate out of the cabinet"),
    "plate-slide-back-side": (
        "slide the plate sideways out of the cabinet",
        "pull the plate sideways out of the cabinet",
    ),
    "peg-insert-side": ("insert the peg into the hole", "put the peg into the side of the box"),
    "peg-unplug-side": ("unplug the peg", "pull the peg out"),
    "soccer": ("kick the ball into the goal", "push the ball into the net"),
    "stick-push": ("push the bottle with the stick", "take the stick and push the bottle with it"),
    "stick-pull": ("pull the bottle with the stick", "take the stick and pull the bottle with it"),
    "push": ("push the puck to the goal", "slide the puck to the goal"),
    "push-wall": ("push the puck around the wall to the goal", "slide the puck past the wall"),
    "push-back": ("pull the puck back to the goal", "move the puck back to the goal"),
    "reach": ("reach the goal", "move the gripper to the goal"),
    "reach-wall": ("reach the goal behind the wall", "go around the wall to the goal"),
    "shelf-place": ("put the puck on the shelf", "pick up the puck and place it on the shelf"),
    "sweep-into": ("sweep the puck into the hole", "push the puck into the hole"),
    "sweep": ("sweep the puck off the table", "push the puck off the table"),
    "window-open": ("open the window", "slide the window open"),
    "window-close": (
        "close the window",
        "slide the window shut",
        "push the window to the left",
    ),
}

SETS: dict[str, tuple[str, ...]] = {
    "mt4": ("button-press", "drawer-open", "door-open", "window-close"),
    "mt10": (
        "reach",
        "push",
        "pick-place",
        "door-open",
        "drawer-open",
        "drawer-close",
        "button-press-topdown",
        "peg-insert-side",
        "window-open",
        "window-close",
    ),
    "mt50": tuple(SENTENCES),
}

_TASK = TaskSpec(
    name="",
    action_names=("dx", "dy", "dz", "grip"),
    proprio_names=("hand_x_m", "hand_y_m", "hand_z_m", "gripper_opening"),
    max_steps=250,  # twice what experts need; the benchmark's own limit is 500
    control_hz=80.0,
    templates=(),
    camera=CAMERA,
)


def names() -> tuple[str, ...]:
    """The names of all tasks and sets in `aegis`."""
    return tuple(METAWORLD + name for name in (*SETS, *SENTENCES))


def members(name: str) -> tuple[str, ...]:
    """The tasks of a set, in the benchmark's order; for a task, only itself."""
    short = name.removeprefix(METAWORLD)
    return tuple(METAWORLD + task for task in SETS.get(short, (short,)))


def sentences(task: str) -> tuple[str, ...]:
    """The instructions of a task."""
    return SENTENCES[task.removeprefix(METAWORLD)]


def spec(name: str) -> TaskSpec:
    """The facts of a task, or of a set, with the instructions of all its tasks."""
    said = (text for task in members(name) for text in sentences(task))
    return replace(_TASK, name=name, templates=tuple(dict.fromkeys(said)))
