"""The wide vocabulary: scenes, easy-VQA and robot instructions in one closed list of words.

A model with this vocabulary can be asked both kinds of questions, and be trained on tasks whose
instructions never occurred in its questions.
"""

from __future__ import annotations

from aegis_cli.data.vqa.questions import vocabulary

# easy-VQA's words that scenes lack; its question mark is a separate word.
_EASY_VQA = "? circle rectangle triangle teal black brown gray image contain not present in".split()

# Instructions of dm_control's suite: names of its domains and tasks, as `make the DOMAIN TASK`.
_SUITE = (
    "make acrobot swingup sparse cup catch cartpole balance poles cheetah run stand walk trot "
    "fetch spin turn easy hard fish upright swim hopper hop humanoid cmu pure state lqr 1 2 4 6 "
    "manipulator peg insert pendulum quadruped escape reacher stacker stack swimmer swimmer6 "
    "swimmer15 walker dog"
).split()

# Words of MetaWorld's fifty tasks, and others commonly used to describe such tasks.
_METAWORLD = (
    "press push pull pick place open close lock unlock grasp grab take get lift lower hold release "
    "drop throw dunk kick slide sweep rotate turn twist insert unplug plug assemble assembly "
    "disassemble remove hit hammer bypass avoid align attach shut use using pass aim score "
    "keep carry switch flip slip poke shove strike drag "
    "button door drawer window box bin shelf cabinet table wall hole goal position puck peg nut "
    "ring basketball basket hoop rim net ball soccer football coffee mug machine cup dial knob "
    "faucet tap handle lever plate stick nail screw block cover lid hand gripper robot wrench tool "
    "thermos bottle socket slot joint bolt clock rack top front side back end edge center middle "
    "corner bottom "
    "up down out off from under below above behind through around along against beside between by "
    "with without and then while until away inside outside near next topdown sideways backwards "
    "forward forwards backward toward towards across past clockwise counter-clockwise "
    "counterclockwise revolving random again "
    "start stop begin locked unlocked opened closed "
    "another other one its that this your all both first second third last degrees 90 180 "
    "large small big little long short round flat wooden metal disc"
).split()


def wide_vocabulary() -> tuple[str, ...]:
    """The words of scenes first, in their own order, then all others."""
    return tuple(dict.fromkeys((*vocabulary(), *_EASY_VQA, *_SUITE, *_METAWORLD)))
