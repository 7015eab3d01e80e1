"""Which tests belong to `pytest -m fast`: about 1,500 that run in about a minute on two cores.

The rule: all rooms whose tests are pure computation, except the files that repeat it over many
draws, and one or more files of every other room that neither train nor render. Files are listed as
a whole, unless single tests of them are named.
"""

from __future__ import annotations

ROOMS = ("core", "recipes")
MANY_DRAWS = (
    "core/test_identification.py",
    "core/test_merging.py",
    "core/test_nullspace.py",
    "core/test_projection.py",
    "core/test_routing.py",
    "core/test_spectrum.py",
)
FILES = (
    "anchors/test_anchor_inputs.py",
    "campaign/test_damage.py",
    "cli/test_render.py",
    "common/test_artifacts.py",
    "common/test_files.py",
    "common/test_pictures.py",
    "continual/test_learners.py",
    "data/lerobot/test_lerobot_statistics.py",
    "data/vqa/test_metrics.py",
    "docs/test_prose.py",
    "evaluation/test_bootstrap.py",
    "guard/test_guard_structure.py",
    "methods/test_kfac.py",
    "models/test_attention.py",
    "models/test_expert.py",
    "models/test_flow.py",
    "models/test_policy.py",
    "reporting/test_compare.py",
    "serving/test_wire.py",
    "sim/test_planner.py",
    "studies/test_table_file.py",
    "test_imports.py",
    "training/test_step.py",
)
TESTS = (
    "merging/test_merge.py::test_the_weakest_that_passes_is_taken_wherever_it_stands",
    "pretraining/test_pretrain.py::test_the_recipe_that_ships_loads",
    "pretraining/test_pretrain_dual.py::"
    "test_the_loss_is_least_where_positives_win_and_no_others_count_against_them",
    "publishing/test_push.py::test_what_is_no_repository_is_refused",
)


def file_is_fast(path: str) -> bool:
    """Whether all tests of a file, named from the folder `tests`, are fast."""
    if path in MANY_DRAWS:
        return False
    return path in FILES or path.split("/")[0] in ROOMS


def test_is_fast(path: str, function: str) -> bool:
    """Whether a test function of that file is fast, whatever its parameters."""
    return file_is_fast(path) or f"{path}::{function}" in TESTS


def may_be_fast(path: str) -> bool:
    """Whether a file has fast tests at all."""
    return file_is_fast(path) or any(name.startswith(f"{path}::") for name in TESTS)
