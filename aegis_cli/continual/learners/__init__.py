"""The learners of streams by name."""

from aegis_cli.common.errors import AegisError
from aegis_cli.continual.learners import (
    igsp,
    isolated_lora,
    moe_adapters,
    prototype,
    sequential,
    sequential_lora,
    zero_shot,
)
from aegis_cli.continual.learners.base import Learner

_MODULES = (zero_shot, sequential, sequential_lora, isolated_lora, moe_adapters, prototype, igsp)
LEARNERS: dict[str, Learner] = {m.LEARNER.name: m.LEARNER for m in _MODULES}


def get(name: str) -> Learner:
    """The learner of that name."""
    if name not in LEARNERS:
        raise AegisError(
            f"learner '{name}'", f"one of {', '.join(LEARNERS)}", "choose with --method"
        )
    return LEARNERS[name]
