"""Pages of results: they show what the records say, and say when a record is stale."""

import pkgutil
import re
import sys
from pathlib import Path
from typing import Any

import pytest

from tests import inside


@pytest.fixture(scope="module")
def every():
    with inside.benchmark("all") as module:
        yield module


@pytest.fixture
def records(every, monkeypatch, tmp_path):
    monkeypatch.setattr(every.sections, "RECORDS", tmp_path)
    return every.sections


def section(sections: Any, settings: dict, rows: list[dict], **about: Any) -> Any:
    return sections.Section(
        name="some",
        settings=lambda: settings,
        measure=lambda work, quick: rows,
        show=lambda rows: f"{len(rows)} rows",
        **about,
    )


def test_a_record_is_stale_when_settings_of_what_it_measured_have_changed(records):
    case = {"model.name": "six_planes", "model.loss.opacity": 0.1}
    rows = [{"case": "one", "psnr": 1 / 3}, {"case": "two", "psnr": 2.0}]
    old = section(records, {"one": case, "two": {**case, "seeds": 3}}, rows)
    assert records.why_stale(old) == "never measured"
    records.write_record("some", {"version": "1"}, old.settings(), rows)
    assert records.read_record("some") == {
        "made": {"version": "1"},
        "settings": old.settings(),
        "rows": [{"case": "one", "psnr": 0.33333}, rows[1]],
    }
    assert records.why_stale(old) == ""
    new = {"one": {**case, "model.loss.opacity": 0.2}, "two": old.settings()["two"], "three": case}
    words = records.why_stale(section(records, new, rows))
    assert words == "three has not been measured, model.loss.opacity went from 0.1 to 0.2 (one)"
    # A setting that is new: what it was then is what it is when it is off.
    off = {name: {**case, "data.new": False} for name, case in old.settings().items()}
    assert records.why_stale(section(records, off, rows)) == ""
    on = {name: {**case, "data.new": True} for name, case in old.settings().items()}
    assert records.why_stale(section(records, on, rows)) == "data.new went from None to True"
    records.write_record("some", {"version": "1"}, {}, rows)
    assert "version 1" in records.why_stale(old)


@pytest.mark.parametrize(
    ("scene", "stale"),
    [
        ({"data.name": "dnerf", "data.scene": "lego"}, False),
        ({"data.name": "suite", "data.scene": "topology"}, False),
        ({"data.name": "suite", "data.scene": "rig"}, True),
        ({"data.name": "nerfstudio", "data.scene": "hand"}, True),
    ],
)
def test_settings_of_surroundings_make_only_their_scenes_stale(records, scene, stale):
    then = {**scene, "model.sampler.border": 0.1, "model.resolution": 64}
    records.write_record("some", {"version": "1"}, {"one": then}, [])
    now = {**then, "model.sampler.border": 0.2, "model.resolution": "auto"}
    now["model.loss.rig_passing_steps"] = 600
    words = records.why_stale(section(records, {"one": now}, []))
    assert ("border" in words and "resolution" in words and "rig_passing" in words) is stale
    assert bool(words) is stale
    now["model.loss.variation_views"] = 50  # All images, from more places than that.
    assert ("variation" in records.why_stale(section(records, {"one": now}, []))) is stale
    few = {**now, "data.views": 5}
    records.write_record("some", {"version": "1"}, {"one": {**then, "data.views": 5}}, [])
    assert "variation" in records.why_stale(section(records, {"one": few}, []))
    other = {**now, "model.loss.opacity": 0.2}
    assert "opacity" in records.why_stale(section(records, {"one": other}, []))


def test_what_does_not_change_a_measurement_is_not_among_its_settings(records):
    def settings(*changes: str) -> dict:
        return records.settings_of(("data.scene=balls", *changes))

    same = ("data.root=/there", "preparation.cache=null", "callbacks.checkpoints.every=1")
    assert settings(*same, "logger=none", "trainer.enable_progress_bar=false") == settings()
    for changed in ("model.loss.opacity=0.2", "lrm=none", "trainer.max_steps=5", "data.views=5"):
        assert settings(changed) != settings(), changed


def test_a_repeated_measurement_is_compared_with_its_record(records):
    then = [{"case": "one", "psnr": 20.0, "psnr_std": 0.5}, {"case": "two", "psnr": 20.0}]
    records.write_record("some", {"version": "1"}, {}, then)
    now = [{"case": "one", "psnr": 21.4}, {"case": "two", "psnr": 21.4}, {"case": "three"}]
    found = records.drift(section(records, {}, now), now)
    assert [line[:4] for line in found] == [
        ("one", "psnr", "20", "21.4"),
        ("two", "psnr", "20", "21.4"),
    ]
    assert [bool(line[4]) for line in found] == [False, True]


def test_rows_have_means_and_deviations_and_wait_for_all_runs(records, monkeypatch, tmp_path):
    folders: list[Path] = []

    def run(overrides: list[str], folder: Path, script: Path) -> Any:
        seed = int(overrides[-1].removeprefix("seed="))
        folders.append(folder)
        seconds = {"prepare": {"fill": 1.0}, "train": 2.0, "total": 4.0}
        metrics = {"test": {"psnr": 20.0 + seed, "ssim": 0.5}, "seconds": seconds, "step": 10}
        metrics |= {"samples_per_ray": 3.0, "skipped": {"empty": 0.5}, "parameters": 7}
        metrics |= {"peak_memory_bytes": 1e9}
        curve = [{"seconds": f"{t}", "step": f"{t}", "psnr": f"{seed + t}"} for t in (0, 1)]
        return records.Measured(metrics, curve)

    monkeypatch.setattr(records, "run_apart", run)
    cases = [records.Case("a", ("lrm=none",), quick=True), records.Case("b", ("lrm=none",), 1)]
    first, second = records.train_all(cases, tmp_path)
    assert (first["psnr"], first["psnr_std"], first["seeds"]) == (21, 1, 3)
    assert (first["first"], first["prepare"], first["cpu"], first["empty"]) == (1, 1, 12, 0.5)
    assert first["curve"] == [[0, 1, 1], [1, 2, 1]]
    assert (second["psnr"], second.get("psnr_std")) == (20, None)
    assert [row["case"] for row in records.train_all(cases, tmp_path, quick=True)] == ["a"]
    monkeypatch.setitem(records.LIMITS, "until", 0)
    with pytest.raises(records.OutOfTimeError, match="4 of 4"):
        records.train_all(cases, tmp_path)
    folder = next(path for path in folders if path.name.startswith("b_0"))
    folder.mkdir()
    (folder / "metrics.json").touch()
    with pytest.raises(records.OutOfTimeError, match="3 of 4") as caught:
        records.train_all(cases, tmp_path)
    assert [row["case"] for row in caught.value.rows] == ["b"]


def test_measuring_writes_a_record_and_its_page(every, records, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    page = tmp_path / "page.md"
    page.write_text("Words.\n\n<!-- measured: some -->\nOld.\n<!-- end -->\n\nMore.\n")
    made = section(records, {"one": {"a": 1}}, [{"case": "one", "psnr": 20.0, "cpu": 360}])
    monkeypatch.setattr(every, "every_section", lambda: {"some": made})
    monkeypatch.setattr(every, "summaries", dict)
    monkeypatch.setattr(every, "pages", lambda: [page])
    monkeypatch.setattr(sys, "argv", ["all.py"])
    assert every.main() == 0
    assert "\nNot measured yet.\n<!-- end -->\n\nMore." in page.read_text()
    monkeypatch.setattr(sys, "argv", ["all.py", "--measure", "--only", "some"])
    assert every.main() == 0
    text = page.read_text()
    assert "Words.\n\n<!-- measured: some -->\n1 rows\n\n*Version" in text
    assert "0.1 hours" in text
    monkeypatch.setattr(sys, "argv", ["all.py", "--check"])
    assert every.main() == 0
    assert page.read_text() == text


STALE = re.compile(r"^\*\*Stale\*\*: .*\n\n", re.MULTILINE)


def test_pages_show_what_the_records_say(every, monkeypatch):
    monkeypatch.setattr(every.sections, "why_stale", lambda section: "")
    known, tables, seen = every.every_section(), every.summaries(), []
    for name in every.MODULES:
        monkeypatch.setattr(sys.modules[name], "save", lambda figure, name: None)
    for page in every.pages():
        text = page.read_text(encoding="utf-8")
        for match in every.BLOCK.finditer(text):
            seen.append(match[2])
            shown = STALE.sub("", match[0].removeprefix(match[1]))
            table = tables.get(match[2])
            expected = f"{table()}\n" if table else every.block(known[match[2]])
            assert shown == expected, f"{match[2]}: run benchmarks/all.py"
    assert sorted(seen) == sorted([*known, *tables])


@pytest.mark.slow
def test_settings_of_all_cases_exist_and_name_no_folder(every):
    for name, section in every.every_section().items():
        for case, settings in section.settings().items():
            assert settings, (name, case)
            folders = [key for key, value in settings.items() if str(value).startswith("/")]
            assert not folders, (name, case)


def test_printed_commands_name_no_folder(every):
    words = ["--lego", "/there/lego", "data.root=/there", "data.scene=lego", "--seeds", "3"]
    printed = ["--lego", "FOLDER", "data.root=FOLDER", "data.scene=lego", "--seeds", "3"]
    assert sys.modules["runner"].without_folders(words) == printed


def test_stages_that_are_timed_exist():
    with inside.benchmark("where_time_goes") as timed:
        for _, module, path in timed.STAGES:
            assert callable(pkgutil.resolve_name(f"{module}:{path}")), path
