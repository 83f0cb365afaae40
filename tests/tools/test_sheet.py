"""Contact sheets: tiles cut from the pictures of runs, and errors that name what is missing."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

from tests.tools.test_table import make, set_to
from xplanes.cli import main
from xplanes.errors import ConfigError
from xplanes.tools.sheet import WHAT, check_what, write_sheet

TRUE, ERROR, DEPTH = (255, 0, 0), (0, 0, 255), (255, 0, 255)
SIDE = 20


def green(step: int) -> tuple[int, int, int]:
    """The colour that a run shows after some steps."""
    return (0, 100 + step, 0)


def pictured(
    folder: Path,
    *,
    scene: str = "lego",
    model: str = "a",
    seed: int = 0,
    steps=(0, 50),
    views=("v0", "v1"),
) -> Path:
    run = make(folder, model=model, seed=seed)
    set_to(run, data={"scene": scene})
    for step in steps:
        for view in views:
            strip = np.concatenate(
                [np.full((SIDE, SIDE, 3), c, "uint8") for c in (TRUE, green(step), ERROR, DEPTH)], 1
            )
            path = run / "media" / f"step{step:06d}" / f"{view}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(strip).save(path)
    return run


def areas(path: Path) -> dict[tuple[int, ...], int]:
    """Pixels of each colour of a sheet; greys, of which text consists, left out."""
    with Image.open(path) as picture:
        pixels = np.asarray(picture.convert("RGB")).reshape(-1, 3)
    colours, counts = np.unique(pixels, axis=0, return_counts=True)
    return {
        tuple(map(int, colour)): int(count)
        for colour, count in zip(colours, counts, strict=True)
        if len(set(colour)) > 1
    }


def test_runs_stand_side_by_side_a_row_per_scene(tmp_path):
    for number, (scene, model) in enumerate([("lego", "a"), ("lego", "b"), ("hook", "a")]):
        pictured(tmp_path / f"{number}", scene=scene, model=model)
    found = areas(write_sheet(tmp_path, size=40))
    # The truth once per scene, the last step of each run.
    assert found[TRUE] == 2 * 40 * 40
    assert found[green(50)] == 3 * 40 * 40
    assert not {ERROR, DEPTH, green(0)} & set(found)


def test_a_setting_is_shown_with_its_first_seed(tmp_path):
    for number, (model, seed) in enumerate([("a", 0), ("a", 1), ("b", 0), ("b", 1)]):
        pictured(tmp_path / f"{number}", model=model, seed=seed)
    assert areas(write_sheet(tmp_path, size=40))[green(50)] == 2 * 40 * 40
    assert areas(write_sheet(tmp_path, what="steps", size=40))[green(50)] == 4 * 40 * 40
    # Runs that differ in nothing else are all shown.
    for number in (2, 3):
        shutil.rmtree(tmp_path / f"{number}")
    assert areas(write_sheet(tmp_path, size=40))[green(50)] == 2 * 40 * 40


def test_steps_stand_side_by_side_a_row_per_run(tmp_path):
    for number, model in enumerate("ab"):
        pictured(tmp_path / f"{number}", model=model, steps=(0, 20, 50))
    path = write_sheet(tmp_path, tmp_path / "other.png", what="steps", size=40)
    assert areas(path) == dict.fromkeys((TRUE, green(0), green(20), green(50)), 2 * 40 * 40)
    path = write_sheet(tmp_path, what="steps", steps=[20], show="depth", size=40)
    assert areas(path) == {TRUE: 2 * 40 * 40, DEPTH: 2 * 40 * 40}


def test_a_video_shows_a_step_after_the_other_beside_the_truth(tmp_path):
    for number, steps in enumerate([(0, 20, 50), (0, 80)]):
        pictured(tmp_path / f"{number}", model=f"{number}", steps=steps)
    video = write_sheet(tmp_path, tmp_path / "video.webp", what="steps", size=40)
    frames, milliseconds = [], []
    with Image.open(video) as picture:
        for frame in ImageSequence.Iterator(picture):
            frames.append(np.asarray(frame.convert("RGB")).reshape(-1, 3).astype(int))
            milliseconds.append(frame.info["duration"])

    def area(frame: int, colour: tuple[int, int, int]) -> int:
        # Of a lossy picture; the greens of two steps are at least 20 apart.
        return int((np.abs(frames[frame] - colour).max(axis=1) < 8).sum())

    for frame, shown in enumerate([(0, 0), (20, 80), (50, 80)]):
        for step in {0, 20, 50, 80}:
            expected = shown.count(step) * 40 * 40
            assert area(frame, green(step)) == pytest.approx(expected, abs=400), (frame, step)
        assert area(frame, TRUE) == pytest.approx(2 * 40 * 40, abs=400)
    assert milliseconds == [500, 500, 2000]


def test_parts_are_shown_whole_and_each_kind_of_sheet_has_a_file_of_its_own(tmp_path):
    run = pictured(tmp_path / "run")
    with pytest.raises(ConfigError, match=r"no run has media/decomposition\.png: only runs"):
        write_sheet(run, what="parts")
    Image.new("RGB", (60, 30), (1, 2, 3)).save(run / "media" / "decomposition.png")
    written = [write_sheet(run, what=what) for what in WHAT]
    assert [path.name for path in written] == [
        "sheet_runs.png",
        "sheet_steps.png",
        "sheet_parts.png",
    ]
    assert areas(written[-1]) == {(1, 2, 3): 60 * 30}


def test_a_single_run_is_a_sheet_of_itself_and_the_command_writes_it(tmp_path, capsys):
    run = pictured(tmp_path / "run")
    assert main(["sheet", str(run), "--what", "steps", "--steps", "0,50", "--view", "v1"]) == 0
    assert capsys.readouterr().out == f"wrote {run / 'sheet_steps.png'}\n"
    assert set(areas(run / "sheet_steps.png")) == {TRUE, green(0), green(50)}


def test_a_view_is_found_by_the_end_of_its_name(tmp_path):
    pictured(tmp_path / "new", views=("val_r_003", "val_r_013"))
    # Earlier runs wrote the split twice before images in a folder of its name.
    pictured(tmp_path / "old", model="b", views=("val_val_r_003", "val_val_r_013"))
    expected = write_sheet(tmp_path, view="val_r_003").read_bytes()
    for name in ("r_003", "003", "val/r_003.png", "val_val_r_003"):
        assert write_sheet(tmp_path, view=name).read_bytes() == expected, name
    assert write_sheet(tmp_path, view="13").read_bytes() != expected
    words = r"^view=3: val_r_003 and val_r_013 end with it; name one of them$"
    with pytest.raises(ConfigError, match=words):
        write_sheet(tmp_path, view="3")
    with pytest.raises(ConfigError, match=r"^view=r_9: the runs of lego show val_r_003, val_r_013"):
        write_sheet(tmp_path, view="r_9")


def test_what_is_missing_is_named(tmp_path):
    pictured(tmp_path / "0")
    pictured(tmp_path / "1", model="b", views=("v1",))
    write_sheet(tmp_path, view="v1")
    cases = [
        ({"view": "v0"}, r"^view=v0: the runs of lego show v1$"),
        ({"steps": [7]}, r"^steps=7: 0 has pictures of the steps 0, 50$"),
        ({"show": "truth"}, r"^show=truth: must be one of colour, error, depth$"),
        ({"size": 3}, r"^size=3"),
        ({"out": tmp_path / "x.jpg"}, r"x\.jpg: a contact sheet must end in \.png, or with"),
        ({"out": tmp_path / "x.webp"}, r"x\.webp: a contact sheet must end in \.png, or with"),
    ]
    for options, words in cases:
        with pytest.raises(ConfigError, match=words):
            write_sheet(tmp_path, **options)
    pictured(tmp_path / "2", model="c", views=("v9",))
    with pytest.raises(ConfigError, match="the runs of lego have no view in common"):
        write_sheet(tmp_path)
    make(tmp_path / "bare" / "0")
    with pytest.raises(ConfigError, match=r"no run has pictures of views"):
        write_sheet(tmp_path / "bare")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="no runs in it"):
        write_sheet(tmp_path / "empty")
    check_what(None)
    with pytest.raises(ConfigError, match=r"sheet=all: must be null or one of runs, steps, parts"):
        check_what("all")
