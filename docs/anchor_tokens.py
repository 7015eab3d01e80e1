"""What an anchor's inputs lose on a share of the tokens: the table of docs/performance.md.

    python docs/anchor_tokens.py --questions 300

The embedded VLM is asked the same questions for each share. What is printed: of the energy that all
tokens' second moment has, the part that the directions of a share hold, which hold 99 % or 99.99 %
of their own; the mean over the maps, and the least. The last line has all tokens of as many other
questions.
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor

from aegis_cli.anchors import inputs
from aegis_cli.core.spectrum import Spectrum, rank
from aegis_cli.data.vqa.dataset import VQASet, load_scenes
from aegis_cli.models import backbones
from aegis_cli.models.backbones.base import Backbone

SHARES = (0.5, 0.25, 0.125, 0.0625)
ENERGIES = (0.99, 0.9999)


def spectra(model: Backbone, asked: VQASet, share: float = 1.0) -> dict[str, Spectrum]:
    """The maps' inputs with all their directions."""
    found = inputs.measure(model, asked, 1.0, drawn=inputs.Drawn(share))
    return {site: spectrum for site, spectrum in found.items() if spectrum.kind == "dense"}


def held(moment: Tensor, part: Spectrum, energy: float) -> float:
    """The part of a second moment's energy along the leading directions of another."""
    assert part.vectors is not None
    leading = part.vectors[:, : rank(part.values, energy)].double()
    return float((leading * (moment @ leading)).sum() / moment.trace())


def line(name: str, moments: dict[str, Tensor], parts: dict[str, Spectrum]) -> str:
    """A row of the table."""
    cells = []
    for energy in ENERGIES:
        shares = torch.tensor([held(moments[site], parts[site], energy) for site in moments])
        cells += [f"{100 * shares.mean():.3f}", f"{100 * shares.min():.3f}"]
    return f"| {name} | {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--questions", type=int, default=300)
    given = parser.parse_args()
    model = backbones.load("embedded")
    asked = load_scenes("anchor", given.questions).sized(model.image_size)
    moments = {}
    whole = spectra(model, asked)
    for site, spectrum in whole.items():
        assert spectrum.vectors is not None
        vectors = spectrum.vectors.double()
        stored = spectrum.values[: vectors.shape[1]]  # without the directions of no energy
        moments[site] = vectors * stored @ vectors.T
    print("| tokens | 99 %: mean | least | 99.99 %: mean | least |")
    print(line("all", moments, whole))
    for share in SHARES:
        print(line(f"{share:g}", moments, spectra(model, asked, share)))
    others = load_scenes("anchor", given.questions, seed=1).sized(model.image_size)
    print(line("all, of other questions", moments, spectra(model, others)))


if __name__ == "__main__":
    main()
