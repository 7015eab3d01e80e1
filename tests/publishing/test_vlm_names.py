"""A VLM's tensors are found in a policy by names and shapes, and the action expert's never are."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import foreign

from aegis_cli.common.errors import AegisError
from aegis_cli.publishing import vlm_names
from aegis_cli.publishing.vlm_names import Asked, Spec

WORDS, WIDTH, DEPTH = 40, 16, 4
COMMAND = ("extract", "policy", "--base", "base")
PARTS = st.sampled_from(["model", "policy", "vlm", "vlm_with_expert", "paligemma", "net", "core"])
PREFIXES = st.lists(PARTS, max_size=4).map(lambda parts: "".join(f"{part}." for part in parts))
SIZES = {
    "self_attn.q_proj.weight": (WIDTH, WIDTH),
    "mlp.up_proj.weight": (2 * WIDTH, WIDTH),
    "input_layernorm.weight": (WIDTH,),
}
# As PaliGemma's repository has them; its words are scored by the table.
SEEING = {
    "vision_tower.encoder.layers.0.self_attn.q_proj.weight": (8, 8),
    "vision_tower.encoder.layers.1.self_attn.q_proj.weight": (8, 8),
    "vision_tower.embeddings.position_embedding.weight": (9, 8),
    "multi_modal_projector.linear.weight": (WIDTH, 8),
}
GENERATIONS = {
    "saved": str,
    "modules": foreign.of_modules,
    "before 5.5": lambda name: foreign.with_vision_model(foreign.of_modules(name)),
    "before 4.52": foreign.with_vision_model,
}
TABLE, HEAD = "language_model.model.embed_tokens.weight", "language_model.lm_head.weight"


def layers(depth: int, width_of: float = 1) -> dict[str, tuple[int, ...]]:
    return {
        f"layers.{i}.{name}": tuple(int(size * width_of) for size in shape)
        for i in range(depth)
        for name, shape in SIZES.items()
    }


def base(depth: int = DEPTH) -> dict[str, Spec]:
    own = {f"language_model.model.{name}": shape for name, shape in layers(depth).items()}
    own |= {TABLE: (WORDS, WIDTH), "language_model.model.norm.weight": (WIDTH,), **SEEING}
    return {name: Spec(shape, "F32") for name, shape in own.items()}


def policy(
    vlm: Mapping[str, Spec], prefix: str, generation: str, expert: float = 0.5
) -> dict[str, Spec]:
    """The VLM under a prefix, and beside it an expert of some width."""
    named = {prefix + GENERATIONS[generation](name): spec for name, spec in vlm.items()}
    beside = {
        f"{prefix}gemma_expert.model.{name}": Spec(shape, "F32")
        for name, shape in layers(DEPTH, expert).items()
    }
    return {**beside, **named, f"{prefix}action_in_proj.weight": Spec((3, 8), "F32")}


def found(
    own: Mapping[str, Spec],
    other: Mapping[str, Spec],
    tied: bool = True,
    prefix: str | None = None,
) -> vlm_names.Match:
    return vlm_names.match(own, other, tied, Asked("policy", "base", prefix, COMMAND))


@given(PREFIXES, st.sampled_from(sorted(GENERATIONS)), st.sampled_from([0.5, 1.0]))
def test_each_tensor_is_found_under_any_prefix_in_any_generation_of_names(
    prefix: str, generation: str, width: float
) -> None:
    own = base()
    match = found(own, policy(own, prefix, generation, width))
    assert match.taken == {name: prefix + GENERATIONS[generation](name) for name in own}
    assert match.kept == () and match.rows == {} and match.prefix.startswith(prefix)
    assert not any("gemma_expert" in other for other in match.taken.values())


@given(
    st.sampled_from(sorted(GENERATIONS)),
    st.sampled_from(sorted(GENERATIONS)),
    st.integers(1, DEPTH),
)
def test_a_base_of_any_generation_has_the_layers_behind_the_policys_kept(
    of_base: str, of_policy: str, depth: int
) -> None:
    saved = base()
    own = {GENERATIONS[of_base](name): spec for name, spec in saved.items()}
    there = {n: s for n, s in saved.items() if not foreign.is_layer(n, depth)}
    match = found(own, policy(there, "model.vlm.", of_policy))
    upper = {GENERATIONS[of_base](n) for n in saved if foreign.is_layer(n, depth)}
    assert {name for kept in match.kept for name in kept.names} == upper
    assert set(match.taken) == set(own) - upper
    spans = {1: "layers 1 to 3", 2: "layers 2 to 3", 3: "layer 3"}
    assert [kept.what for kept in match.kept] == (
        [f"language {spans[depth]}"] if depth < DEPTH else []
    )


@given(st.sampled_from(sorted(base())))
def test_whatever_else_is_missing_is_refused(name: str) -> None:
    own = base()
    last = foreign.is_layer(name, DEPTH - 1)
    if name == "language_model.model.norm.weight":
        return  # it is behind the layers
    there = {n: spec for n, spec in own.items() if n != name}
    with pytest.raises(AegisError) as caught:
        found(own, policy(there, "model.vlm.", "modules"))
    assert name in caught.value.found, last


@given(st.sampled_from(sorted(base())), st.sampled_from(["modules", "saved"]))
def test_another_shape_is_refused_and_named(name: str, generation: str) -> None:
    own = base()
    shape = (*own[name].shape[:-1], own[name].shape[-1] + 1)
    other = policy({**own, name: Spec(shape, "F32")}, "model.vlm.", generation)
    with pytest.raises(AegisError, match="do not have the shapes") as caught:
        found(own, other)
    assert str(list(shape)) in caught.value.found


def test_whole_numbers_in_the_place_of_weights_are_refused() -> None:
    own = base()
    packed = {**own, TABLE: Spec(own[TABLE].shape, "I8")}
    with pytest.raises(AegisError, match="I8"):
        found(own, policy(packed, "model.", "modules"))


@pytest.mark.parametrize("rows", [-6, 6])
def test_tables_may_have_other_numbers_of_words(rows: int) -> None:
    own = base()
    longer = {**own, TABLE: Spec((WORDS + rows, WIDTH), "F32")}
    assert found(own, policy(longer, "model.", "modules")).rows == {TABLE: WORDS + min(rows, 0)}


@pytest.mark.parametrize("generation", sorted(GENERATIONS))
def test_a_head_alone_is_the_table_of_a_tied_base(generation: str) -> None:
    own = base()
    there = {HEAD if name == TABLE else name: spec for name, spec in own.items()}
    match = found(own, policy(there, "model.vlm.", generation))
    assert match.taken[TABLE] == f"model.vlm.{GENERATIONS[generation](HEAD)}"
    assert match.second is None and match.kept == ()


def test_one_of_two_tied_tables_is_both() -> None:
    own = base() | {HEAD: base()[TABLE]}
    for gone, there in ((HEAD, TABLE), (TABLE, HEAD)):
        rest = {name: spec for name, spec in own.items() if name != gone}
        match = found(own, policy(rest, "", "saved"))
        assert match.taken[gone] == match.taken[there] == there


def test_an_untied_head_is_kept_and_an_untied_table_refused() -> None:
    own = base() | {HEAD: base()[TABLE]}
    without_head = {name: spec for name, spec in own.items() if name != HEAD}
    match = found(own, policy(without_head, "", "saved"), tied=False)
    assert [kept.names for kept in match.kept] == [(HEAD,)]
    without_table = {name: spec for name, spec in own.items() if name != TABLE}
    with pytest.raises(AegisError, match="not behind its last layer"):
        found(own, policy(without_table, "", "saved"), tied=False)


def test_a_second_table_of_the_policys_is_told_apart() -> None:
    own = base()
    match = found(own, policy(own | {HEAD: own[TABLE]}, "model.", "modules"))
    assert match.taken[TABLE] == "model.model.language_model.embed_tokens.weight"
    assert match.second == ("model.lm_head.weight", match.taken[TABLE])
    assert match.second[0] not in match.more


def test_what_only_the_policy_has_is_listed() -> None:
    own = base()
    more = own | {"multi_modal_projector.scale": Spec((1,), "F32")}
    match = found(own, policy(more, "model.vlm.", "modules"))
    assert "model.vlm.model.multi_modal_projector.scale" in match.more


ADAPTERS = (
    "lora_A.default.weight",
    "lora_B",
    "lora_magnitude_vector",
    "adapter.down.weight",
    "weight_scale_inv",
)


@pytest.mark.parametrize("generation", sorted(GENERATIONS))
@pytest.mark.parametrize("adapter", ADAPTERS)
def test_an_adapter_inside_of_a_module_is_refused(generation: str, adapter: str) -> None:
    own = base()
    module = "language_model.model.layers.1.self_attn.q_proj."
    more = own | {module + adapter: Spec((4, WIDTH), "F32")}
    with pytest.raises(AegisError, match="beside the VLM's weights") as caught:
        found(own, policy(more, "model.vlm.", generation))
    assert adapter in caught.value.found and "merge the adapter" in caught.value.fix


def test_a_bias_that_the_base_does_not_have_is_listed() -> None:
    own = base()
    name = "language_model.model.layers.1.self_attn.q_proj.bias"
    match = found(own, policy(own | {name: Spec((WIDTH,), "F32")}, "", "saved"))
    assert name in match.more


COMPILED = {
    "language_model.model.": "language_model._orig_mod.model.",
    "layers.1.": "layers.1._orig_mod.",
    "vision_tower.": "vision_tower._orig_mod.",
    "self_attn.": "self_attn._checkpoint_wrapped_module.",
}


@pytest.mark.parametrize("part", COMPILED)
@pytest.mark.parametrize("generation", sorted(GENERATIONS))
def test_names_of_compiled_parts_are_found(part: str, generation: str) -> None:
    own = base()
    named = {name: GENERATIONS[generation](name) for name in own}
    if part == "language_model.model." and generation != "saved":
        named = {
            n: o.replace("language_model.", "language_model._orig_mod.") for n, o in named.items()
        }
    else:
        named = {n: o.replace(part, COMPILED[part]) for n, o in named.items()}
    match = found(own, {f"model.vlm.{named[name]}": spec for name, spec in own.items()})
    assert match.taken == {name: f"model.vlm.{named[name]}" for name in own}


@pytest.mark.parametrize("dtype", ["I8", "U8", "F8_E4M3"])
def test_a_quantised_policy_is_refused_with_what_to_do(dtype: str) -> None:
    own = base()
    packed = {
        name: Spec(spec.shape, dtype if "q_proj" in name else spec.dtype)
        for name, spec in own.items()
    }
    with pytest.raises(AegisError, match="are quantised") as caught:
        found(own, policy(packed, "model.", "modules"))
    assert dtype in caught.value.found and "dequantise the policy first" in caught.value.fix


def test_whole_numbers_of_another_type_are_refused() -> None:
    own = base() | {"vision_tower.embeddings.position_ids": Spec((1, 9), "I64")}
    other = own | {"vision_tower.embeddings.position_ids": Spec((1, 9), "I32")}
    with pytest.raises(AegisError, match=r"I32 \[1, 9\] instead of I64"):
        found(own, policy(other, "model.", "modules"))


def with_average(generation: str, prefixes: tuple[str, str] = ("net.", "ema.")) -> dict[str, Spec]:
    one, other = prefixes
    return policy(base(), one, generation) | policy(base(), other, generation)


def test_two_copies_of_the_vlm_are_refused_with_a_command_for_one() -> None:
    with pytest.raises(AegisError, match=r"2 VLMs in 'policy' .* 'net\.', 'ema\.'") as caught:
        found(base(), with_average("modules"))
    assert "aegis extract policy --base base --prefix net" in caught.value.fix


@pytest.mark.parametrize("generation", sorted(GENERATIONS))
@pytest.mark.parametrize("given", ["ema", "ema.", "e", "{}"])
def test_a_prefix_chooses_one_of_two_copies(generation: str, given: str) -> None:
    own, other = base(), with_average(generation)
    alone = found(own, policy(own, "ema.", generation))
    if given == "e":  # no part of a name
        with pytest.raises(AegisError, match=r"no VLM under --prefix 'e' .* 'net\.', 'ema\.'"):
            found(own, other, prefix=given)
        return
    # The report names a longer one where a part that keys ignore is common to all names.
    match = found(own, other, prefix=given.format(alone.prefix))
    assert match.taken == alone.taken and match.more == alone.more
    assert match.others == ("net.",) and alone.others == ()


@pytest.mark.parametrize("generation", sorted(GENERATIONS))
def test_a_copy_at_the_root_is_chosen_by_no_prefix(generation: str) -> None:
    own, other = base(), with_average(generation, ("", "ema."))
    with pytest.raises(AegisError, match=r"under '' \(no prefix\), 'ema\.'") as caught:
        found(own, other)
    assert caught.value.fix.endswith("--prefix ''")
    alone = found(own, policy(own, "", generation))
    for chosen, prefix in (("", ""), ("ema", "ema.")):
        match = found(own, other, prefix=chosen)
        assert match.taken == {name: prefix + taken for name, taken in alone.taken.items()}
        assert not any(name.startswith("ema.") for name in match.more if not prefix)


def test_the_beginning_of_several_prefixes_chooses_none() -> None:
    other = with_average("modules", ("a.net.", "a.ema."))
    with pytest.raises(AegisError, match="2 VLMs under --prefix 'a'"):
        found(base(), other, prefix="a")
    assert found(base(), other, prefix="a.ema").taken


def test_a_prefix_may_be_given_where_there_is_one_vlm() -> None:
    own = base()
    other = policy(own, "model.vlm.", "modules")
    assert found(own, other, prefix="model") == found(own, other)
    with pytest.raises(AegisError, match=r"no VLM under --prefix 'ema' .* under 'model\.vlm\.'"):
        found(own, other, prefix="ema")


def test_of_two_vlms_the_one_of_the_bases_shapes_is_taken() -> None:
    own = base()
    wider = {n: Spec(tuple(2 * size for size in s.shape), "F32") for n, s in own.items()}
    other = policy(own, "small.", "modules") | policy(wider, "large.", "modules")
    assert found(own, other).prefix == "small.model."


def test_a_base_with_fewer_layers_is_refused() -> None:
    with pytest.raises(AegisError, match="behind the 3 of 'base'"):
        found(base(3), policy(base(), "model.", "modules"))


def test_a_policy_without_vision_or_without_anything_of_it_is_refused() -> None:
    own = base()
    blind = {name: spec for name, spec in own.items() if name not in SEEING}
    with pytest.raises(AegisError, match="and none of its vision"):
        found(own, policy(blind, "model.", "modules"))
    with pytest.raises(AegisError, match=r"none of the tensors .* which has model\.resnet\.0"):
        found(own, {"model.resnet.0.weight": Spec((3, 3), "F32")})


def test_buffers_that_later_releases_do_not_save_are_kept() -> None:
    own = base()
    older = own | {
        "vision_tower.embeddings.position_ids": Spec((1, 9), "I64"),
        "language_model.model.layers.0.self_attn.rotary_emb.inv_freq": Spec((4,), "F32"),
    }
    assert [kept.what for kept in found(older, policy(own, "", "modules")).kept] == ["buffers"]
