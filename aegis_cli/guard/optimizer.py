"""AdamW that preserves what a VLM knows, for programs that accept nothing but an optimizer.

Such a program gives the optimizer parameters without names. The weights themselves tell which map
of the VLM they are, because the anchor was measured on them. Parameters that belong to no map of
the VLM, such as those of an action expert, move as under plain AdamW.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Collection, Generator, Iterable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from aegis_cli import methods
from aegis_cli.anchors import anchor_file
from aegis_cli.common.errors import AegisError, few
from aegis_cli.core.anchor import Anchor
from aegis_cli.core.pairs import Pair
from aegis_cli.guard import matching, wide_step
from aegis_cli.guard.options import load_anchor, method_options
from aegis_cli.guard.stepper import SlowedStep, overflowed
from aegis_cli.guard.wide_step import WideStep
from aegis_cli.methods import kfac
from aegis_cli.methods.base import MethodContext, Parts
from aegis_cli.methods.site_weights import weights
from aegis_cli.methods.stepper import Stepper
from aegis_cli.models.backbones.base import Backbone

CONSTRAINING = ("kfac", "nullspace")
_PLACE = "aegis_place"  # in a parameter's state: the number of its role in the base model
# In a weight's state, the offset of its bias in the optimizer's order; in a bias's, of its weight.
_PARTNER = "aegis_partner"
_log = logging.getLogger(__name__)


class ProtectedAdamW(torch.optim.AdamW):
    """AdamW whose applied updates a method constrains, in the maps of one VLM.

    Its state is that of AdamW plus, for each protected parameter, a number that tells what it is in
    the VLM. So a resumed run can identify them although its weights are no longer those of the VLM.

    A protected parameter in half precision is updated in float32: its master weight is part of the
    state, and the parameter is the rounded master.
    """

    def __init__(
        self,
        params: Iterable[Any],
        method: str,
        anchor: str | Path,
        base: Backbone,
        options: Mapping[str, Any],
        **adamw: Any,
    ) -> None:
        """Find the VLM's maps among the parameters.

        With `kfac`, the VLM's other parameters (normalisations, tables) are frozen, unless the
        option `weight` is 0.

        Args:
            params: as for AdamW.
            method: one of CONSTRAINING.
            anchor: file from `aegis anchor`, with the part that the method reads.
            base: the VLM that the anchor was measured on.
            options: the method's options, as in a recipe; `every` is 1.
            adamw: AdamW's own settings.

        Raises:
            AegisError: the anchor is of another VLM or lacks that part, or an option is unknown.
        """
        super().__init__(params, **adamw)
        if method not in CONSTRAINING:
            expected = f"one of {', '.join(CONSTRAINING)}"
            raise AegisError(f"method '{method}'", expected, "choose another optimizer")
        self._method, self._options = method, method_options(method, {**options, "every": 1})
        if method == "kfac":
            rate = float(self.defaults["lr"])
            if why := kfac.why_strong(self._options["weight"], rate, "--optimizer.weight"):
                _log.warning(why)
        self._anchor, header = load_anchor(method, Path(anchor))
        if header.fingerprint != base.fingerprint():
            raise AegisError(
                f"anchor '{anchor}', which was not measured on the base model's weights"
                f"{anchor_file.measured_on(header)}",
                "the VLM that the anchor was measured on",
                "name it as the base, as in aegis anchor --backbone",
            )
        self._kinds = _kinds(method, base, self._anchor, self._options)
        self._lone = self._kinds.keys() - base.site_modules().keys()
        # Only these tensors stay in memory, not the base model.
        self._base = {site: _copied(weights(base, site)) for site in self._kinds}
        # Weight and bias of each site have a number, by which a resumed run identifies them.
        self._places = [(site, part) for site in sorted(self._base) for part in (0, 1)]
        self._found: dict[str, Pair] = {}
        # In a resumed run some weights have moved and others have not: those without a gradient,
        # and in half precision those that stayed within rounding. The state, which is loaded later,
        # identifies them; the first step matches again.
        with contextlib.suppress(AegisError):
            self._found = matching.match(self._base, self._ordered())
        # Frozen parameters by name, and the VLM's values of those to freeze that were not found.
        self._frozen: list[tuple[str, Tensor]] = []
        self._lost: dict[str, Tensor] = {}
        if method == "kfac" and self._options["weight"] > 0:
            self._frozen, self._lost = matching.freeze_rest(base, self._base, self.param_groups)
        self._notes: dict[Tensor, dict[str, int]] = {}  # what each parameter's state remembers
        self._stepper: Stepper | None = None
        self._wide = WideStep(self, ())
        self._parts = Parts()
        self._count = 0

    @property
    def protected(self) -> tuple[str, ...]:
        """Names of the VLM's maps that were found among the parameters."""
        return tuple(self._found)

    def step(self, closure: Callable[[], float] | None = None) -> float | None:
        """Take AdamW's step, and let the method constrain what it did to the VLM.

        If a scaler has found that the gradients overflowed, nothing is done.

        Raises:
            AegisError: at the first step, if none of the VLM's maps is among the parameters, they
                cannot be identified, some have learned or are tables of another size, or half of
                one is frozen; at any step, if a parameter of the VLM learns that was frozen at the
                first.
        """
        if overflowed(self):
            return None
        self._refuse_thawed()
        if self._stepper is None:
            self._start()
        assert self._stepper is not None
        self._count += 1
        loss = None
        if closure is not None:
            # A pass needs the parameters in the program's own dtypes.
            with torch.enable_grad():
                loss = closure()

        def move() -> None:
            slowed = SlowedStep(self._parts)
            super(ProtectedAdamW, self).step()
            slowed.go_back()

        # AdamW and the constraint both run in float32: a projected update that was rounded in
        # between would no longer be orthogonal. Neither method reads an anchor gradient.
        with self._wide.taken():
            self._stepper.step(self._count, move, {})
        self._remember()
        return loss

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load the result of `state_dict`; moments and masters that were float32 stay so."""
        with wide_step.loading(self, state_dict):
            super().load_state_dict(state_dict)

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Add a group, as AdamW does, before the first step.

        Raises:
            AegisError: the method has started and would not protect the VLM's parameters in it.
        """
        if getattr(self, "_stepper", None) is not None:
            raise AegisError(
                "a group of parameters that is added after the first step",
                "all groups before it: a later one could not be protected where it is the VLM's",
                "make a new optimizer of all parameters, which continues with this one's state",
            )
        super().add_param_group(param_group)

    def _refuse_thawed(self) -> None:
        """Refuse a step on parameters that were frozen at the start, as nothing protects them."""
        thawed = [name for name, parameter in self._frozen if parameter.requires_grad]
        if thawed:
            raise AegisError(
                f"{len(thawed)} parameters of the base model that were frozen and learn again, "
                f"first '{thawed[0]}'",
                "what learned at the first step",
                "let every map that should learn do so from the first step on; kfac protects only "
                "linear maps and convolutions, and normalisations and tables stay frozen",
            )

    def _ordered(self) -> list[Tensor]:
        """The parameters in the order in which their state is saved."""
        return [p for group in self.param_groups for p in group["params"]]

    def _start(self) -> None:
        """Start the method on the maps, with the VLM's weights as their origin."""
        known = self._known_again()
        found = self._found | known
        absent = {site: pair for site, pair in self._base.items() if site not in found}
        found |= matching.match(absent, self._ordered(), matching.ids(found))
        matching.refuse_half_frozen(found)
        learning = {site: pair for site, pair in found.items() if pair[0].requires_grad}
        for site in found.keys() - learning.keys():
            self._frozen.append((site, found[site][0]))
        if not learning:
            raise AegisError(
                f"none of the {len(self._base)} maps of the base model is among what learns",
                "a policy whose VLM learns, and still has the weights of the base model",
                "let the VLM learn (for SmolVLA: --policy.train_expert_only=false), and name the "
                "VLM that it begins with as the base",
            )
        # In a resumed run they have learned; the check was made when training began.
        if not known:
            matching.refuse_strays(self._base, found, self._ordered())
            matching.refuse_lost(self._lost, self._base, found, self._ordered())
        # A method works on named modules, which the program does not provide.
        model = _tree(learning, self._lone)
        kinds = {site: self._kinds[site] for site in learning}
        device = next(model.parameters()).device
        anchor = anchor_file.to_device(self._anchor, device)
        self._wide = WideStep(self, model.parameters())
        # A method takes the current values for the pre-trained ones, which those of a resumed run
        # no longer are.
        with self._wide.taken(), _at_origin(learning, self._base):
            context = MethodContext(model, {}, kinds, self._options, anchor)
            self._parts = methods.get(self._method).start(context)
        _report(self._method, learning, self._base.keys() - found.keys())
        self._stepper = Stepper(model, self._parts)
        self._found = learning
        self._notes = self._to_remember()
        self._base.clear()
        self._lost.clear()

    def _known_again(self) -> dict[str, Pair]:
        """The sites that a loaded state identifies.

        Raises:
            AegisError: the shape of one differs from that of the parameter.
        """
        ordered = self._ordered()
        at = {parameter: place for place, parameter in enumerate(ordered)}
        pairs: dict[str, list[Tensor | None]] = {}
        for parameter, state in self.state.items():
            if _PLACE not in state:
                continue
            site, part = self._places[int(state[_PLACE])]
            pair = pairs.setdefault(site, [None, None])
            pair[part] = parameter
            # The partner has no state if it never had a gradient, but it may still have moved along
            # with this one.
            if _PARTNER in state:
                pair[1 - part] = ordered[at[parameter] + int(state[_PARTNER])]
        for site, pair in pairs.items():
            for parameter, value in zip(pair, self._base[site], strict=True):
                shapes = [None if t is None else tuple(t.shape) for t in (parameter, value)]
                if shapes[0] != shapes[1]:
                    raise AegisError(
                        f"a parameter {shapes[0]} for {site} {shapes[1]} of the base model",
                        "the state of a training with this anchor and base model",
                        "resume with the ones the training began with",
                    )
        return {site: (weight, bias) for site, (weight, bias) in pairs.items()}  # type: ignore[misc]

    def _to_remember(self) -> dict[Tensor, dict[str, int]]:
        """The numbers by which a resumed run identifies each protected parameter."""
        at = {parameter: place for place, parameter in enumerate(self._ordered())}
        notes = {}
        for number, (site, part) in enumerate(self._places):
            pair = self._found.get(site, (None, None))
            parameter, partner = pair[part], pair[1 - part]
            if parameter is None:
                continue
            notes[parameter] = {_PLACE: number}
            if partner is not None:
                notes[parameter][_PARTNER] = at[partner] - at[parameter]
        return notes

    def _remember(self) -> None:
        """Store these numbers in each protected parameter's state, once AdamW has created it."""
        for parameter, numbers in self._notes.items():
            # AdamW initialises only an empty state, so nothing may be stored there before.
            if state := self.state.get(parameter):
                for name, number in numbers.items():
                    state.setdefault(
                        name, torch.tensor(float(number), dtype=torch.float32, device="cpu")
                    )


def _kinds(
    method: str, base: Backbone, anchor: Anchor, options: Mapping[str, Any]
) -> dict[str, str]:
    """The sites of the base model that the method protects, with their kinds."""
    sites = base.sites()
    measured = set(anchor.inputs)
    if method == "kfac":
        # The curvature has two factors for each map, `SITE.inputs` and `SITE.outputs`.
        measured = {name.rpartition(".")[0] for name in anchor.curvature}
    return {s: kind for s, kind in sites.items() if s in measured and kind in options["protect"]}


def _copied(pair: Pair) -> Pair:
    weight, bias = pair
    return matching.on_cpu(weight), None if bias is None else matching.on_cpu(bias)


@contextlib.contextmanager
def _at_origin(found: Mapping[str, Pair], base: Mapping[str, Pair]) -> Generator[None]:
    """Give the parameters the VLM's values inside the block, and restore their own afterwards."""
    pairs = []
    for site, pair in found.items():
        for parameter, value in zip(pair, base[site], strict=True):
            if parameter is not None and value is not None:
                pairs.append((parameter, value))
    now = [parameter.detach().clone() for parameter, _ in pairs]
    with torch.no_grad():
        for parameter, value in pairs:
            parameter.copy_(value)
    try:
        yield
    finally:
        with torch.no_grad():
            for (parameter, _), value in zip(pairs, now, strict=True):
                parameter.copy_(value)


def _report(method: str, found: Collection[str], absent: Collection[str]) -> None:
    _log.info("%s protects %d maps of the VLM", method, len(found))
    if absent:
        named = few(sorted(absent))
        _log.warning("%d maps of the base model are not in the policy: %s", len(absent), named)


def _tree(found: Mapping[str, Pair], lone: Collection[str]) -> nn.Module:
    """Modules that hold the parameters under their names in the base model."""
    root = nn.Module()
    for site, pair in found.items():
        # The pair of a lone row is (row, None), and its site is the row's own name.
        names = [site] if site in lone else [f"{site}.weight", f"{site}.bias"]
        for name, parameter in zip(names, pair, strict=False):
            if parameter is not None:
                _put(root, name, parameter)
    return root


def _put(root: nn.Module, name: str, parameter: Tensor) -> None:
    *path, leaf = name.split(".")
    here = root
    for part in path:
        if not hasattr(here, part):
            here.add_module(part, nn.Module())
        here = getattr(here, part)
    assert isinstance(parameter, nn.Parameter)
    here.register_parameter(leaf, parameter)
