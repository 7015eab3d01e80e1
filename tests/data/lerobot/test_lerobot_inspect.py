"""`aegis demos --format lerobot` and `aegis inspect` on what it wrote."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from samples.lerobot import TEXTS, edit_info, episodes, joined, save

from aegis_cli import inspection
from aegis_cli.common import artifacts
from aegis_cli.common.errors import AegisError
from aegis_cli.data import record
from aegis_cli.data.lerobot import dataset, layout

pytestmark = pytest.mark.usefixtures("frame_cache")

TILE, CAPTION, GAP = 192, 20, 4


def inspected(aegis: Any, *args: object) -> dict[str, Any]:
    code, out, _ = aegis("inspect", *args, "--json")
    assert code == 0
    return json.loads(out)


def test_what_a_dataset_is(aegis: Any, tmp_path: Path) -> None:
    made = episodes(6, ("top", "wrist"))
    lengths, actions = [len(e.actions) for e in made], joined(made)[1].astype(np.float64)
    report = inspected(aegis, save(tmp_path / "d", made))
    facts = report["facts"]
    assert report["kind"] == "dataset"
    assert (facts["version"], facts["episodes"], facts["frames"], facts["fps"]) == (
        "v3.0",
        6,
        sum(lengths),
        10,
    )
    assert facts["frames_an_episode"] == {"least": min(lengths), "most": max(lengths)}
    assert facts["duration_s"] == pytest.approx(sum(lengths) / 10)
    assert (facts["cameras"], facts["tasks"]) == (
        ["observation.images.top", "observation.images.wrist"],
        list(TEXTS),
    )
    assert (facts["robot_type"], facts["task"], facts["statistics"]) == ("arm", None, True)
    features = {feature["name"]: feature for feature in report["features"]}
    assert features["action"]["components"] == ["dx", "dy"] and features["action"]["shape"] == [2]
    np.testing.assert_allclose(features["action"]["statistics"]["mean"], actions.mean(0), atol=1e-9)
    assert features["observation.images.top"]["components"] == ["red", "green", "blue"]
    assert len(features["observation.images.top"]["statistics"]["q99"]) == 3


def test_the_table_has_a_line_a_number(aegis: Any, tmp_path: Path) -> None:
    made = episodes()
    save(tmp_path / "d", made)
    lines = [line.split() for line in aegis("inspect", tmp_path / "d")[1].splitlines()]
    (dy,) = [line for line in lines if line[:2] == ["action", "dy"]]
    assert dy[2:4] == ["float32", "2"] and float(dy[4]) == pytest.approx(
        joined(made)[1][:, 1].min(), rel=1e-3
    )
    assert ["episodes", "5"] in lines


def test_an_array_has_one_line(aegis: Any, tmp_path: Path) -> None:
    """LeRobot may have depth maps in its rows too, with statistics of each pixel."""
    folder = save(tmp_path / "d")
    depth = {"dtype": "uint16", "shape": [480, 640], "names": None}
    edit_info(folder, lambda info: info["features"].update({"observation.depth": depth}))
    stats = json.loads((folder / layout.STATS).read_text())
    stats["observation.depth"] = {"mean": [[1.0] * 640] * 480}
    (folder / layout.STATS).write_text(json.dumps(stats))
    features = {feature["name"]: feature for feature in inspected(aegis, folder)["features"]}
    assert features["observation.depth"]["components"] == []
    assert features["observation.depth"]["statistics"] == {}
    lines = [line.split() for line in aegis("inspect", folder)[1].splitlines()]
    (told,) = [line for line in lines if line[:1] == ["observation.depth"]]
    assert told[1:6] == ["uint16", "480", "x", "640", "-"]


def test_nameless_numbers_without_statistics_have_one_line(aegis: Any, tmp_path: Path) -> None:
    folder = save(tmp_path / "d")
    (folder / layout.STATS).unlink()
    edit_info(folder, lambda info: info["features"]["observation.state"].update(names=None))
    lines = [line.split() for line in aegis("inspect", folder)[1].splitlines()]
    assert len([line for line in lines if line[:1] == ["observation.state"]]) == 1
    assert len([line for line in lines if line[:1] == ["action"]]) == 2


def test_a_picture_of_depth_has_no_colours(aegis: Any, tmp_path: Path) -> None:
    folder = save(tmp_path / "d", episodes(2, ("top", "depth")))

    def mark(info: dict[str, Any]) -> None:
        info["features"]["observation.images.depth"]["info"] = {"is_depth_map": True}

    edit_info(folder, mark)
    features = {feature["name"]: feature for feature in inspected(aegis, folder)["features"]}
    assert features["observation.images.depth"]["components"] == ["depth"]
    assert features["observation.images.top"]["components"] == ["red", "green", "blue"]
    for name in ("depth", "observation.images.depth"):
        with pytest.raises(AegisError, match=f"(?s)'{name}' in .* shows depth.*one of: [^,]*top\n"):
            dataset.load(folder).cameras(name)


def test_a_dataset_without_statistics_or_names(aegis: Any, tmp_path: Path) -> None:
    folder = save(tmp_path / "d")
    (folder / layout.STATS).unlink()
    edit_info(folder, lambda info: info["features"]["action"].update(names=None))
    edit_info(
        folder,
        lambda info: info["features"]["observation.state"].update(
            names={"motors": ["a", "b", "c"]}
        ),
    )
    features = {feature["name"]: feature for feature in inspected(aegis, folder)["features"]}
    assert features["action"]["statistics"] == {} and features["observation.state"][
        "components"
    ] == ["a", "b", "c"]
    lines = [line.split() for line in aegis("inspect", folder)[1].splitlines()]
    assert ["action", "float32", "2", *"------"] in lines
    for name in "abc":
        assert ["observation.state", name, "float32", "3", *"------"] in lines
    assert sum(line[:1] == ["observation.images.top"] for line in lines) == 1


@pytest.mark.parametrize("as_video", [False, True])
def test_the_sheet_shows_episodes_ends_from_every_camera(
    as_video: bool, aegis: Any, tmp_path: Path
) -> None:
    made = episodes(12, ("top", "wrist"), (64, 64), smooth=True)
    folder = save(tmp_path / "d", made, as_video=as_video)
    inspected(aegis, folder, "--plot", tmp_path / "sheet.png")
    sheet = np.asarray(Image.open(tmp_path / "sheet.png")).astype(int)
    shown = np.linspace(0, 11, 8).round().astype(int)
    assert {0, 11} <= set(shown)
    cell, line = sheet.shape[1] // 2, TILE + CAPTION + 8
    for i, number in enumerate(shown):
        episode, (x, y) = made[number], (i % 2 * cell, i // 2 * line)
        pictures = [episode.frames[camera][t] for camera in ("top", "wrist") for t in (0, -1)]
        for k, picture in enumerate(pictures):
            left = x + 4 + k * (TILE + GAP)
            tile = sheet[y + CAPTION : y + CAPTION + TILE, left : left + TILE]
            assert np.abs(tile.mean((0, 1)) - picture.mean((0, 1))).max() <= 12 * as_video, (i, k)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["d", "sheet.png"]


def test_recorded_demonstrations_are_a_dataset_of_their_task(aegis: Any, tmp_path: Path) -> None:
    """The recording does not depend on the format, and equal arguments give equal bytes."""
    args = ("demos", "point", "--episodes", 3, "--format", "lerobot", "--json")
    code, out, _ = aegis(*args, "--out", tmp_path / "d", "--preview", tmp_path / "p.png")
    report = json.loads(out)
    assert code == 0 and (report["episodes"], report["out"]) == (3, str(tmp_path / "d"))
    facts = inspected(aegis, tmp_path / "d")["facts"]
    assert (facts["task"], facts["robot_type"]) == ("point", "aegis/point")
    assert (facts["episodes"], facts["frames"]) == (3, report["frames"])
    record.run("point", 3, 0, tmp_path / "d.safetensors", workers=1, preview=tmp_path / "q.png")
    meta = artifacts.read_header(tmp_path / "d.safetensors").meta
    features = {f.name: f for f in inspection.run(tmp_path / "d").features}
    assert list(features["action"].components) == meta["action_names"]
    assert list(features["observation.state"].components) == meta["proprio_names"]
    assert sorted(facts["tasks"]) == meta["instructions"] and facts["fps"] == meta["control_hz"]
    assert (tmp_path / "p.png").read_bytes() == (tmp_path / "q.png").read_bytes()
    assert json.loads(aegis(*args, "--out", tmp_path / "e")[1])["sha256"] == report["sha256"]


def test_recorded_as_video(aegis: Any, tmp_path: Path) -> None:
    code, _, _ = aegis(
        "demos", "point", "--episodes", 2, "--format", "lerobot", "--video", "--out", tmp_path / "d"
    )
    assert (
        code == 0 and len(list((tmp_path / "d/videos/observation.images.top").rglob("*.mp4"))) == 1
    )
    assert {f.dtype for f in inspection.run(tmp_path / "d").features if "images" in f.name} == {
        "video"
    }
