"""iGSP (arXiv 2605.19301): a task's optimisation decides which earlier experts it shares.

Phase 1, subspace identification: the task's router gets all experts of earlier tasks and
`candidates` new ones. The loss is the task's loss plus

    reuse * (sum over maps l of n_l m_l) / (sum over maps of n_l) + norm * sum of ||B_c A_c||_F^2
    over new experts

where n_l is the count of numbers in a map's new experts and m_l the mean weight on them over the
positions that the loss reads (`identification.charge`). The first term is the share of the new
numbers that the routers use. A gradient therefore flows into new directions only if old ones do not
suffice (`core/routing.py` explains why that is a projection). The second term is needed: with the
first alone, the router's weight of a new expert falls while the expert's norm grows, and the expert
carries the fit at a weight near zero. `reuse` has no effect in the first task, which has no
history. When the routers have converged, experts with little weight *and* little load leave the
router (`identification.needed`): new ones are deleted, old ones only lose their logit in this
task's router. Possibly no new expert remains, which is pure reuse.

Phase 2, orthogonal subspace fine-tuning: the structure and the routers' parameters are fixed, both
terms are dropped, and the remaining new experts learn, together with the scales. `orthogonal: true`
also removes all components in the columns of earlier tasks' experts from the gradients of these
experts, and from the applied updates (Adam would rotate them back).

The two phases, pre-expansion, the regularisation towards history and pruning by routing come from
the paper's abstract. All details are ours: the form of the penalty, the norm, the load rule, the
initial routers, rank, candidates, thresholds, sites. `reuse: 0` and `prune: false` are ablations.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from aegis_cli.continual.learners.base import (
    Constraint,
    Flows,
    Identification,
    Learner,
    TaskContext,
    Traces,
    keep_experts,
    route_task,
)
from aegis_cli.core.identification import basis, charge, needed, squared_norm, without_span
from aegis_cli.core.routing import RoutedLinear, Router


def begin(context: TaskContext) -> None:
    """Pre-expand the basis: earlier tasks' experts first, then the new ones."""
    options = context.options
    for site in context.sites.values():
        history = site.numbers
        new = [
            site.add_expert(options["rank"], context.task, context.generator)
            for _ in range(options["candidates"])
        ]
        router = route_task(site, context.task, (*history, *new), context)
        start(router, len(history), len(new), options["history"])


@torch.no_grad()
def start(router: Router, old: int, new: int, share: float) -> None:
    """Give history `share` of the initial weight, and each new expert full strength.

    Full strength, s p_c = 1 with the scale s and the weight p_c, is that of a single expert. With
    uniform weights and a scale of 1 a task would start close to what earlier tasks learned, and
    learn slowly: a step of an expert moves the output by (s p)^2.
    """
    if old:
        assert router.bias is not None
        # A softmax over `old` logits of b and `new` ones of 0 gives history the share
        # old e^b / (old e^b + new).
        router.bias[:old] = math.log(share / (1 - share) * new / old)
    # 1 / p_c, with the weight p_c = (1 - share) / new of each new expert.
    router.scale.fill_(new / (1 - share) if old else new)


def penalty(context: TaskContext, traces: Traces, share: float = 1.0) -> Tensor:
    """The term that phase 1 adds to the loss: the norms; the mass is charged in the backward pass.

    Args:
        share: the share of a step that this pass is; the passes of a step add up to the full term.
    """
    used = {name: _used(site, context.task) for name, site in context.sites.items()}
    # A map without history has nothing to prefer to new experts.
    sizes = {}
    for name, (history, new) in used.items():
        if history:
            sizes[name] = _numbers(context.sites[name], new)
    for name, size in sizes.items():
        history, new = used[name]
        columns = range(len(history), len(history) + len(new))  # new experts come last in a router
        price = share * context.options["reuse"] * size / sum(sizes.values())
        # A map that is applied several times in a step pays as much as one that is applied once.
        for passed in traces[name]:
            charge(passed, columns, price / len(traces[name]))
    norms = []
    for name, (_, new) in used.items():
        norms += [squared_norm(expert) for expert in context.sites[name].of(new)]
    return share * context.options["norm"] * torch.stack(norms).sum()


def settle(context: TaskContext, flows: Flows) -> None:
    """Prune, and freeze the routers except for their scales."""
    options = context.options
    for name, site in context.sites.items():
        router = site.router(context.task)
        assert router is not None
        if options["prune"]:
            columns = needed(flows[name], options["kappa"], options["load"])
            site.restrict(context.task, [router.experts[i] for i in columns])
        for parameter in router.logit_parameters():
            parameter.requires_grad_(False)


def constrain(context: TaskContext) -> Constraint | None:
    """With `orthogonal`, keep updates of new experts orthogonal to the columns of earlier ones."""
    if not context.options["orthogonal"]:
        return None
    held: list[tuple[Tensor, Tensor]] = []  # each new B, and the columns its updates must avoid
    for site in context.sites.values():
        experts = site.of(site.numbers)
        old = [expert.b for expert in experts if expert.owner < context.task]
        if old:
            columns = basis(old)
            held += [(expert.b, columns) for expert in experts if expert.owner == context.task]
    before = [b.detach().clone() for b, _ in held]  # buffers for the values before each step

    @torch.no_grad()
    def gradient() -> None:
        for (b, columns), kept in zip(held, before, strict=True):
            kept.copy_(b)
            if b.grad is not None:
                b.grad.copy_(without_span(b.grad, columns))

    @torch.no_grad()
    def update() -> None:
        for (b, columns), kept in zip(held, before, strict=True):
            # Only the update is projected; components in the span that phase 1 left there stay.
            b.copy_(kept + without_span(b - kept, columns))

    return Constraint(gradient, update)


def _used(site: RoutedLinear, task: int) -> tuple[list[int], list[int]]:
    """Numbers of the experts that the task's router uses: those of earlier tasks, and its own.

    The router has them in this order.
    """
    router = site.router(task)
    assert router is not None
    history, new = list[int](), list[int]()
    for number, expert in zip(router.experts, site.of(router.experts), strict=True):
        (new if expert.owner == task else history).append(number)
    return history, new


def _numbers(site: RoutedLinear, experts: list[int]) -> int:
    """How many numbers these experts of a map store."""
    return sum(p.numel() for expert in site.of(experts) for p in expert.parameters())


LEARNER = Learner(
    "igsp",
    "experts shared where the routers lead, new ones where they must",
    frozen=True,
    begin=begin,
    identification=Identification(penalty, settle),
    constrain=constrain,
    finish=keep_experts,
)
