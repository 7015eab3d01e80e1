"""The contract of every learner of a stream, and the purpose of each."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from samples.streams import SIZE, WIDTH, TinyDual
from samples.subspaces import share_inside
from torch import Tensor

from aegis_cli import recipes
from aegis_cli.common.errors import AegisError
from aegis_cli.continual import learners
from aegis_cli.continual.learners import LEARNERS, igsp, prototype
from aegis_cli.continual.learners.base import Learner, TaskContext, Traces
from aegis_cli.core import routing
from aegis_cli.core.identification import Flow, basis, flow
from aegis_cli.core.routing import Routed, activate, traced
from aegis_cli.recipes import Igsp, MoeAdapters, Prototype, StreamRecipe, StreamTrain

TASKS = 3
WITH_EXPERTS = [name for name, learner in LEARNERS.items() if learner.trains == "experts"]
FROZEN = [name for name in WITH_EXPERTS if LEARNERS[name].frozen]
LIKE = torch.tensor(
    [[1.0, 0.0], [0.0, 1.0], [1.0, 0.1]]
)  # prototypes: the third task resembles the first


class Stream:
    """A learner taking three tasks; training is a random change of the trainable parameters."""

    def __init__(self, name: str, **options: object) -> None:
        sections = {
            "igsp": Igsp(rank=2),
            "moe_adapters": MoeAdapters(rank=2),
            "prototype": Prototype(rank=2),
        }
        made = StreamRecipe("x", "x", train=StreamTrain(method=name), **sections)
        self.learner: Learner = learners.get(name)
        self.options = recipes.options(made) | options
        self.model = TinyDual().requires_grad_(False)
        self.sites: Routed = (
            routing.route(self.model, self.model.sites())
            if self.learner.trains == "experts"
            else {}
        )
        g = torch.Generator().manual_seed(3)
        self.images = torch.randn(6, 3, SIZE, SIZE, generator=g)
        self.texts = ("a one a", "a two b")

    def context(self, task: int) -> TaskContext:
        return TaskContext(
            task,
            TASKS,
            self.model,
            self.sites,
            self.options,
            LIKE[: task + 1],
            torch.Generator().manual_seed(task),
        )

    def learning(self) -> dict[str, Tensor]:
        return {name: p for name, p in self.model.named_parameters() if p.requires_grad}

    def begin(self, task: int) -> TaskContext:
        self.model.requires_grad_(False)
        context = self.context(task)
        self.learner.begin(context)
        return context

    def stir(self, seed: int, size: float = 0.1) -> None:
        g = torch.Generator().manual_seed(seed)
        for p in self.learning().values():
            p.data += size * torch.randn(p.shape, generator=g)

    def flows(self, task: int) -> dict[str, Flow]:
        router = self.learner.router(task)
        with torch.no_grad(), traced(self.sites) as found:
            self.outputs(task)  # all of it is used
        return {n: flow(found[n], s.of(s.router(router).experts)) for n, s in self.sites.items()}

    def learn(self, task: int) -> None:
        """Begin, both phases, end."""
        context = self.begin(task)
        self.stir(10 * task)
        if self.learner.identification is not None:
            self.learner.identification.settle(context, self.flows(task))
            self.stir(10 * task + 1)
        self.learner.finish(context, self.flows(task) if self.sites else {})
        self.model.requires_grad_(False)

    def outputs(self, task: int | None) -> tuple[Tensor, Tensor]:
        activate(self.sites, None if task is None else self.learner.router(task))
        return self.model.image_features(self.images), self.model.text_features(self.texts)


def equal(a: tuple[Tensor, Tensor], b: tuple[Tensor, Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


# --- all learners ---------------------------------------------------------------------------------


def test_there_are_the_rivals_and_igsp() -> None:
    experts = {"sequential-lora", "isolated-lora", "moe-adapters", "prototype", "igsp"}
    assert set(LEARNERS) >= {"zero-shot", "sequential", *experts}
    assert set(WITH_EXPERTS) >= experts and set(FROZEN) >= {"isolated-lora", "igsp"}


@pytest.mark.parametrize("name", LEARNERS)
def test_its_options_are_the_recipes_key_of_its_name(name: str) -> None:
    learner = LEARNERS[name]
    assert learner.name == name
    assert learner.summary
    assert learner.trains in ("nothing", "model", "experts")
    sections = {f.name for f in dataclasses.fields(StreamRecipe)}
    assert (name.replace("-", "_") in sections) == (learner.trains != "nothing")


@pytest.mark.parametrize("name", LEARNERS)
def test_what_learns_is_what_it_says(name: str) -> None:
    stream = Stream(name)
    for task in range(TASKS):
        stream.begin(task)
        learning = set(stream.learning())
        if stream.learner.trains == "nothing":
            assert not learning
        elif stream.learner.trains == "model":
            assert learning == {n for n, _ in stream.model.named_parameters()}
        else:  # the maps' own weights never learn, nor do frozen ones
            assert learning and all(".experts." in n or ".routers." in n for n in learning)
            frozen = {
                f"{s}.experts.{n}."
                for s, m in stream.sites.items()
                for n, e in m.experts.items()
                if e.frozen
            }
            assert not [n for n in learning if n.startswith(tuple(frozen))]
            stream.learner.finish(stream.context(task), stream.flows(task))


@pytest.mark.parametrize("name", WITH_EXPERTS)
def test_a_first_task_begins_as_the_bare_model(name: str) -> None:
    stream = Stream(name)
    bare = stream.outputs(None)
    stream.begin(0)
    assert equal(stream.outputs(0), bare)
    stream.stir(0)
    assert not equal(stream.outputs(0), bare) and equal(stream.outputs(None), bare)


@pytest.mark.parametrize("name", WITH_EXPERTS)
def test_every_task_has_a_router_everywhere_and_the_bare_model_stays(name: str) -> None:
    stream = Stream(name)
    bare = stream.outputs(None)
    for task in range(TASKS):
        stream.learn(task)
        assert all(
            site.router(stream.learner.router(task)) is not None for site in stream.sites.values()
        )
    assert equal(stream.outputs(None), bare)
    assert not stream.learning()


@pytest.mark.parametrize("name", FROZEN)
@pytest.mark.parametrize("options", [{}, {"prune": False}, {"orthogonal": True}, {"reuse": 0.0}])
def test_frozen_history_is_bit_identical_after_later_tasks(
    name: str, options: dict[str, object]
) -> None:
    stream = Stream(name, **options)
    kept = []
    for task in range(TASKS):
        stream.learn(task)
        kept.append(stream.outputs(task))
        assert all(equal(stream.outputs(i), before) for i, before in enumerate(kept))
    assert not equal(kept[0], kept[1])


@pytest.mark.parametrize("name", ["sequential", "sequential-lora", "prototype"])
def test_what_is_shared_and_goes_on_learning_moves_the_first_task(name: str) -> None:
    stream = Stream(name)
    stream.learn(0)
    before = stream.outputs(0)
    stream.learn(1)
    assert equal(stream.outputs(0), before) == (
        name == "prototype"
    )  # its second task has another expert
    stream.learn(2)
    assert not equal(stream.outputs(0), before)


@pytest.mark.parametrize("name", LEARNERS)
def test_begun_twice_alike_it_is_alike(name: str) -> None:
    """Random draws depend only on the context's generator, not on torch's own."""
    streams = []
    for seed in (0, 99):
        torch.manual_seed(seed)
        stream = Stream(name)
        for task in range(TASKS):
            stream.learn(task)
        streams.append(stream)
    assert all(equal(streams[0].outputs(i), streams[1].outputs(i)) for i in range(TASKS))


def test_an_unknown_learner() -> None:
    with pytest.raises(AegisError, match="igpp"):
        learners.get("igpp")


# --- igsp -----------------------------------------------------------------------------------------


def flows_of(stream: Stream, new_mass: float, new_load: float) -> dict[str, Flow]:
    """Flows with a mass and load for all new experts together, and the rest on the old ones."""
    found = {}
    for name, site in stream.sites.items():
        used = site.routers["1"].experts
        new = torch.tensor([site.experts[str(n)].owner == 1 for n in used])
        parts = [
            torch.where(new, x / new.sum(), (1 - x) / (~new).sum()).double()
            for x in (new_mass, new_load)
        ]
        found[name] = Flow(*parts)
    return found


@pytest.mark.parametrize(
    ("mass", "load", "options", "stay"),
    [
        (0.05, 0.01, {}, 0),
        (0.05, 0.5, {}, 2),
        (0.5, 0.01, {}, 2),
        (0.05, 0.01, {"prune": False}, 2),
        (0.2, 0.01, {"kappa": 0.2}, 2),
        (0.05, 0.15, {"load": 0.2}, 0),
    ],
)
def test_igsp_prunes_by_weight_and_load(
    mass: float, load: float, options: dict[str, object], stay: int
) -> None:
    stream = Stream("igsp", **options)
    stream.learn(0)
    context = stream.begin(1)
    igsp.settle(context, flows_of(stream, mass, load))
    for site in stream.sites.values():
        used = site.routers["1"].experts
        assert sum(site.experts[str(n)].owner == 1 for n in used) == stay
        assert (
            sum(e.owner == 1 for e in site.of(site.numbers)) == stay
        )  # nothing that was removed is stored
        assert not [p for p in site.routers["1"].logit_parameters() if p.requires_grad]
        assert site.routers["1"].scale.requires_grad
        assert all(e.a.requires_grad for e in site.of(site.numbers) if e.owner == 1)
    learning = sum(p.numel() for p in stream.learning().values())
    assert learning == len(stream.sites) if stay == 0 else learning > 100


def test_igsp_lets_a_router_forget_old_experts_too_and_they_stay_for_their_task() -> None:
    stream = Stream("igsp")
    stream.learn(0)
    before = stream.outputs(0)
    context = stream.begin(1)
    igsp.settle(context, flows_of(stream, 0.98, 0.99))
    for site in stream.sites.values():
        assert all(site.experts[str(n)].owner == 1 for n in site.routers["1"].experts)
    assert equal(stream.outputs(0), before)


@pytest.mark.parametrize("share", [0.05, 0.2, 0.6])
@pytest.mark.parametrize("new", [1, 3])
def test_igsp_starts_with_a_share_on_history_and_new_experts_at_full_strength(
    share: float, new: int
) -> None:
    stream = Stream("igsp", history=share, candidates=new)
    for task in range(TASKS):
        stream.begin(task)
        found = stream.flows(task)
        for name, site in stream.sites.items():
            router = site.routers[str(task)]
            old = torch.tensor([e.owner < task for e in site.of(router.experts)])
            assert found[name].mass[old].sum().item() == pytest.approx(
                share if task else 0.0, abs=1e-5
            )
            strength = router.scale.detach() * found[name].mass[~old].float()
            torch.testing.assert_close(strength, torch.ones(new), rtol=1e-4, atol=0)
        stream.stir(task)
        stream.learner.finish(stream.context(task), {})


@pytest.mark.parametrize("reuse", [0.0, 0.3])
def test_igsps_penalty_is_the_share_of_new_numbers_asked_for_and_their_norms(reuse: float) -> None:
    """The loss reads only the second image, where a map's mass is weighted by its experts' size."""
    stream = Stream("igsp", reuse=reuse, norm=0.05)
    for task in range(2):
        context = stream.begin(task)
        stream.stir(task)
        gradients = []
        for by_hand in (False, True):
            with traced(stream.sites) as traces:
                images, texts = stream.outputs(task)
            loss = images[1, 0] + texts[:, 0].sum()
            loss = loss + (
                _penalty_by_hand(stream, task, traces) if by_hand else igsp.penalty(context, traces)
            )
            gradients.append(torch.autograd.grad(loss, list(stream.learning().values())))
        for found, expected in zip(*gradients, strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)
        igsp.keep_experts(context, {})


def _penalty_by_hand(stream: Stream, task: int, traces: Traces) -> Tensor:
    total, asked, whole = torch.zeros(()), torch.zeros(()), 0
    for name, site in stream.sites.items():
        new = [n for n in site.numbers if site.experts[str(n)].owner == task]
        total = total + 0.05 * sum((e.b @ e.a).square().sum() for e in site.of(new))
        columns = [i for i, n in enumerate(site.routers[str(task)].experts) if n in new]
        weights = traces[name][0].weights
        size = (
            stream.options["candidates"]
            * stream.options["rank"]
            * (site.base.in_features + site.base.out_features)
        )
        asked = (
            asked
            + size
            * (weights[1] if name.startswith("image.") else weights)[..., columns].sum(-1).mean()
        )
        whole += size
    return total + stream.options["reuse"] * asked / whole * (
        task > 0
    )  # a first task has no history to reuse


def test_igsps_orthogonal_phase_moves_off_historys_columns_only() -> None:
    """This is about the applied update, not only the gradient: Adam would rotate it back."""
    shares = {}
    for orthogonal in (False, True):
        stream = Stream("igsp", orthogonal=orthogonal, candidates=1, prune=False)
        stream.learn(0)
        context = stream.begin(1)
        stream.stir(5)
        igsp.settle(context, flows_of(stream, 0.9, 0.9))
        constraint = igsp.constrain(context)
        assert (constraint is not None) == orthogonal
        site = stream.sites["image.up"]
        new, columns = site.experts[str(site.numbers[-1])], basis([site.experts["0"].b])
        before = new.b.detach().clone()
        optimizer = torch.optim.AdamW(
            [p for p in stream.model.parameters() if p.requires_grad], lr=0.01
        )
        for _ in range(3):
            optimizer.zero_grad()
            features, _ = stream.outputs(1)
            features[:, 0].sum().backward()
            if constraint is not None:
                constraint.gradient()
            optimizer.step()
            if constraint is not None:
                constraint.update()
        assert (new.b - before).norm() > 1e-3
        shares[orthogonal] = share_inside((new.b - before).detach(), columns)
    assert shares[True] < 1e-9 < 1e-4 < shares[False]


# --- rivals ---------------------------------------------------------------------------------------


def test_prototypes_share_where_images_look_alike() -> None:
    assert prototype.nearest(LIKE[:1], 0.0) is None
    assert prototype.nearest(LIKE[:2], 0.9) is None
    assert prototype.nearest(LIKE, 0.9) == 0 and prototype.nearest(LIKE, 0.999) is None
    stream = Stream("prototype")
    for task in range(TASKS):
        stream.learn(task)
    for site in stream.sites.values():
        assert site.numbers == (0, 1)
        assert site.routers["2"].experts == site.routers["0"].experts == (0,)


def test_moe_adapters_keep_a_pool_and_freeze_the_most_used() -> None:
    stream = Stream("moe-adapters")
    for task in range(TASKS):
        context = stream.begin(task)
        for site in stream.sites.values():
            assert len(site.numbers) == 2 * TASKS
            assert site.routers[str(task)].experts == site.numbers
            assert [e.a.requires_grad for e in site.of(site.numbers)] == [
                not e.frozen for e in site.of(site.numbers)
            ]
        stream.stir(task)
        flows = stream.flows(task)
        free = {
            name: {n for n, e in site.experts.items() if not e.frozen}
            for name, site in stream.sites.items()
        }
        stream.learner.finish(context, flows)
        for name, site in stream.sites.items():
            most = flows[name].mass.topk(2).indices.tolist()
            assert {n for n, e in site.experts.items() if e.frozen} == (
                set(site.experts) - free[name]
            ) | {str(i) for i in most}
            assert all(e.owner <= task for e in site.experts.values() if e.frozen)


def test_moe_adapters_choose_by_image_and_for_all_texts_alike() -> None:
    stream = Stream("moe-adapters")
    stream.begin(0)
    stream.stir(0)
    with torch.no_grad(), traced(stream.sites) as found:
        stream.outputs(0)
    for name, passes in found.items():
        weights = passes[0].weights  # [N, T, E]
        assert torch.equal(
            weights, weights[:, :1].expand_as(weights)
        )  # all positions of a sequence have equal weights
        assert (weights > 0).sum(-1).eq(2).all()
        assert (len(weights[:, 0].unique(dim=0)) == 1) == stream.model.in_text(name)


def test_isolated_loras_share_nothing() -> None:
    stream = Stream("isolated-lora")
    for task in range(TASKS):
        stream.learn(task)
    sites = stream.sites.values()
    assert all(site.routers[str(t)].experts == (t,) for site in sites for t in range(TASKS))
    rank = stream.options["rank"]
    widths = {"out": 2 * WIDTH, "up": 3 * WIDTH, "down": 3 * WIDTH}
    assert sum(site.count() for site in sites) == TASKS * 2 * (rank * sum(widths.values()) + 3)
