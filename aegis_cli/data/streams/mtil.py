"""MTIL: eleven datasets in two orders, with the templates and figures of the papers that used it.

Orders and templates: ZSCL (arXiv 2303.06628); order II starts with StanfordCars. Plain data,
importable without torch.
"""

from __future__ import annotations

TEMPLATES: dict[str, str] = {
    "aircraft": "a photo of a {}, a type of aircraft.",
    "caltech101": "a photo of a {}.",
    "cifar100": "a photo of a {}.",
    "dtd": "a photo of a {} texture.",
    "eurosat": "a centered satellite photo of {}.",
    "flowers": "a photo of a {}, a type of flower.",
    "food": "a photo of a {}, a type of food.",
    "mnist": 'a photo of the number: "{}".',
    "oxford-pet": "a photo of a {}, a type of pet.",
    "stanford-cars": "a photo of a {}, a type of car.",
    "sun397": "a photo of a {}.",
}

STREAMS: dict[str, tuple[str, ...]] = {
    "mtil-1": tuple(TEMPLATES),  # order I
    "mtil-2": (
        "stanford-cars",
        "food",
        "mnist",
        "oxford-pet",
        "flowers",
        "sun397",
        "aircraft",
        "caltech101",
        "dtd",
        "eurosat",
        "cifar100",
    ),
}

# Transfer, Average and Last in percent for order I, CLIP ViT-B/16 and 1,000 iterations per task, as
# the methods' papers print them.
PUBLISHED: dict[str, dict[str, tuple[float, float, float]]] = {
    "mtil-1": {
        "zero-shot": (69.4, 65.3, 65.3),
        "Continual-FT": (44.6, 55.9, 77.3),
        "ZSCL": (68.1, 75.4, 83.6),
        "MoE-Adapters": (68.9, 76.7, 85.0),
        "DIKI": (68.7, 76.3, 85.1),
        "InfLoRA": (66.2, 74.2, 83.6),
    },
}
