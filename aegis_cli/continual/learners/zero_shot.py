"""The bare model: nothing learns."""

from aegis_cli.continual.learners.base import Learner

LEARNER = Learner("zero-shot", "the bare model", trains="nothing", shared=True, frozen=True)
