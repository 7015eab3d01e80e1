"""Parts of a file of demonstrations as files of their own."""

from __future__ import annotations

from pathlib import Path

from aegis_cli.common import artifacts

_OF_EPISODES = ("instruction", "target_color")
_OF_FRAMES = ("frames", "proprio", "actions")


def part(whole: Path, out: Path, first: int, end: int) -> Path:
    """Write episodes `first` to `end - 1` of a file."""
    found = artifacts.load(whole, "demos")
    starts = found.tensors["episode_starts"]
    frames = slice(int(starts[first]), int(starts[end]))
    tensors = {name: found.tensors[name][frames].clone() for name in _OF_FRAMES}
    tensors |= {name: found.tensors[name][first:end].clone() for name in _OF_EPISODES}
    tensors["episode_starts"] = starts[first : end + 1] - starts[first]
    artifacts.save(
        out,
        "demos",
        tensors,
        units={"proprio": "proprio_names", "actions": "share of a full action"},
        meta=found.header.meta,
    )
    return out


def halves(whole: Path, folder: Path, episodes: int) -> tuple[Path, Path]:
    """Two files with the first and the second half of the episodes."""
    middle = episodes // 2
    return (
        part(whole, folder / "first.safetensors", 0, middle),
        part(whole, folder / "second.safetensors", middle, episodes),
    )
