"""The table of a sweep: what differs, how runs ended, means over seeds; nothing stops it."""

import itertools
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml
from PIL import Image

from xplanes import files
from xplanes.config import CONF
from xplanes.errors import ConfigError
from xplanes.tools.published import check_published, read_published
from xplanes.tools.sweep import Point, read_rows
from xplanes.tools.table import _mean_curve, write_tables


def make(
    folder: Path,
    *,
    model: str = "six_planes",
    resolution: int = 64,
    seed: int = 0,
    psnr: float | None = 20.0,
    status: str = "finished",
    reason: str | None = None,
    overrides: tuple[str, ...] = (),
    curve: str = "",
) -> Path:
    """A run directory with the files that tables read."""
    folder.mkdir(parents=True)
    config: dict[str, Any] = {
        "seed": seed,
        "resume": None,
        "data": {"scene": "lego"},
        "model": {"name": model, "plane_set": model.split("_")[0], "resolution": resolution},
        "lrm": {"name": "none"},
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    (folder / "overrides.txt").write_text("".join(f"{line}\n" for line in overrides))
    record = {"status": status, "reason": reason, "started": "2026-01-01T00:00:00+00:00"}
    (folder / "run.json").write_text(json.dumps(record))
    if psnr is not None:
        metrics = {
            "split": "test",
            "test": {"psnr": psnr, "ssim": psnr / 40},
            "step": 300,
            "seconds": {"prepare": {"lrm": 1.5, "convert": 0.5}, "train": 60.25},
            "samples_per_ray": 12.5,
            "parameters": 1234567,
        }
        (folder / "metrics.json").write_text(json.dumps(metrics))
    if curve:
        rows = "".join(f"{row}\n" for row in ("seconds,step,split,psnr,ssim", *curve.split()))
        (folder / "curve.csv").write_text(rows)
    return folder


def sweep(folder: Path, *runs: dict[str, Any]) -> list[Path]:
    """Runs in the folders 0, 1, ..."""
    return [make(folder / f"{number}", **run) for number, run in enumerate(runs)]


def set_to(run: Path, name: str = "config.yaml", **changed: Any) -> None:
    """Change groups or entries of a run's file; mappings are merged with what there is."""
    content = yaml.safe_load((run / name).read_text())
    for key, value in changed.items():
        merge = isinstance(value, dict) and isinstance(content.get(key), dict)
        content[key] = content[key] | value if merge else value
    (run / name).write_text(json.dumps(content))


def table(folder: Path, name: str = "table") -> list[dict[str, str]]:
    write_tables(folder)
    return files.read_rows(folder / f"{name}.csv")


def cells(text: str) -> list[list[str]]:
    """Rows of the Markdown tables in a text: header, rule and what follows."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_columns_are_the_settings_that_differ(tmp_path):
    make(tmp_path / "0_a", model="six_planes")
    make(tmp_path / "1_b", model="nine_planes", psnr=21.0)
    text = write_tables(tmp_path)
    header, _, row, _ = cells(text)
    assert header == [
        *("run", "model", "psnr", "ssim", "floaters", "step 0", "s to 20 dB", "steps"),
        *("prepare s", "train s", "samples/ray", "params", "status"),
    ]
    assert row == [
        *("0_a", "six_planes", "20.00", "0.5000", "", "", "", "300"),
        *("2.0", "60.2", "12.5", "1,234,567", "finished"),
    ]
    assert "2 runs: 2 finished. Scores of the test split." in text
    assert (tmp_path / "table.md").read_text() == text
    assert table(tmp_path)[1]["psnr"] == "21.0"


def test_a_score_of_the_thing_has_a_column_where_any_run_has_one(tmp_path):
    sweep(tmp_path, {"seed": 0}, {"seed": 1})
    assert "psnr_foreground" not in table(tmp_path)[0]
    set_to(tmp_path / "1", "metrics.json", test={"psnr_foreground": 17.5})
    assert [row["psnr_foreground"] for row in table(tmp_path)] == ["", "17.5"]
    assert "psnr object" in (tmp_path / "table.md").read_text()


def test_the_curve_gives_the_psnr_at_step_0_and_the_time_to_20_db(tmp_path):
    # Two seconds of preparation come first.
    cases = [
        ("0,0,test,8,0.1 10,50,test,16,0.2 20,90,test,24,0.3", "8.0", "17.0"),
        ("0,0,test,21,0.1 10,50,test,25,0.2", "21.0", "2.0"),
        ("0,0,test,8,0.1 10,50,test,19,0.2", "8.0", ""),
        ("10,50,test,19,0.2 20,90,test,21,0.2", "", "17.0"),
    ]
    sweep(tmp_path, *({"curve": curve} for curve, _, _ in cases), {"curve": "0,zero,test,8,0.1"})
    *rows, damaged = table(tmp_path)
    found = [(row["start_psnr"], row["seconds_to_20"]) for row in rows]
    assert found == [(start, reached) for _, start, reached in cases]
    assert damaged["status"] == "damaged; curve.csv is damaged"


def test_runs_are_drawn(tmp_path):
    """Their curves, and their PSNR against a setting of several numbers."""
    pytest.importorskip("matplotlib", reason="needs the extra plots")
    curves = [f"0,0,test,{start},0.1 10,50,test,16,0.2" for start in (8, 9)]
    grid = itertools.product("ab", (64, 32), curves)
    sweep(
        tmp_path,
        *({"model": m, "resolution": r, "seed": curves.index(c), "curve": c} for m, r, c in grid),
    )
    text = write_tables(tmp_path)
    assert "![PSNR against seconds and steps](curves.png)" in text
    assert "against.png" not in text
    make(tmp_path / "more", model="a", resolution=128)
    assert "![PSNR at the end](against.png)" in write_tables(tmp_path)
    for name in ("curves", "against"):
        with Image.open(tmp_path / f"{name}.png") as picture:
            assert min(picture.size) > 300


def test_curves_of_seeds_are_averaged_over_what_they_share():
    runs = [
        (Point(0, 0, 10.0), Point(10, 100, 20.0)),
        (Point(2, 0, 10.0), Point(6, 50, 14.0), Point(12, 100, 20.0)),
    ]
    places, values = _mean_curve(runs, "seconds")
    assert (places[0], places[-1]) == (2, 10)
    assert values[0] == pytest.approx((12 + 10) / 2)
    assert values[-1] == pytest.approx((20 + 18) / 2)
    assert _mean_curve(runs[:1], "step") == ([0, 100], [10.0, 20.0])


def test_a_setting_that_was_swept_is_shown_even_if_the_model_decides_it(tmp_path):
    make(tmp_path / "0", model="six_planes", resolution=32, overrides=("model.resolution=32",))
    make(tmp_path / "1", model="nine_planes", resolution=64, overrides=("model.resolution=64",))
    rows = table(tmp_path)
    assert [row["model.resolution"] for row in rows] == ["32", "64"]
    assert "model.plane_set" not in rows[0]


def test_nested_runs_are_found_in_the_order_of_their_numbers_and_their_insides_left_alone(tmp_path):
    for number, name in enumerate(("deep/er/run", "10_run", "2_run", "run/media/not_a_run")):
        make(tmp_path / name, seed=number)
    shutil.copy(tmp_path / "2_run" / "run.json", tmp_path / "run" / "run.json")
    assert [row["run"] for row in table(tmp_path)] == ["2_run", "10_run", "run", "deep/er/run"]


def test_seeds_are_averaged(tmp_path):
    sweep(
        tmp_path,
        *({"seed": seed, "psnr": psnr} for seed, psnr in ((0, 20.0), (1, 22.0), (2, 27.0))),
        {"resolution": 32, "psnr": 10.0, "overrides": ("model.resolution=32",)},
        {"seed": 3, "psnr": None, "status": "failed", "reason": "x"},
        {"seed": 4, "psnr": 99.0, "status": "interrupted"},  # Scores of a shorter training.
    )
    text = write_tables(tmp_path)
    assert "Mean and standard deviation over seeds" in text
    assert "23.00 ± 3.61" in text  # Of the sample: sqrt((9 + 1 + 16) / 2).
    rows = table(tmp_path, "table_seeds")
    assert [row["seeds"] for row in rows] == ["3", "1"]
    assert float(rows[0]["psnr_std"]) == pytest.approx(13**0.5)
    assert rows[1]["psnr_std"] == ""
    assert "seed" not in rows[0]


def test_a_mean_is_that_of_all_seeds_or_there_is_none(tmp_path):
    """Of three seeds one comes to 20 dB, after 10 s: that is not the setting's time."""
    curve = "0,0,test,8,0.1 10,50,test,16,0.2 20,90,test,{},0.3"
    ends = enumerate((24, 15, 16))
    sweep(tmp_path, *({"seed": s, "psnr": 20.0 + s, "curve": curve.format(e)} for s, e in ends))
    (row,) = table(tmp_path, "table_seeds")
    assert row["seconds_to_20"] == ""
    assert float(row["start_psnr"]) == 8
    assert float(row["psnr"]) == 21


def test_a_repetition_with_the_same_seed_is_no_second_seed(tmp_path):
    sweep(tmp_path, *({"seed": seed, "psnr": 20.0 + seed} for seed in (0, 0, 1)))
    assert "20.50 ± 0.71" in write_tables(tmp_path)
    shutil.rmtree(tmp_path / "2")
    assert "standard deviation" not in write_tables(tmp_path)
    assert not (tmp_path / "table_seeds.csv").exists()


def test_runs_that_did_not_finish_are_rows_with_their_reason(tmp_path):
    failed = {"status": "failed", "reason": "TrainingError: a | b\nmore"}
    others = ({"status": "interrupted"}, {"status": "running"}, {})
    sweep(tmp_path, *({"psnr": None, **run} for run in (failed, *others)))
    (tmp_path / "4" / ".hydra").mkdir(parents=True)
    (tmp_path / "4" / ".hydra" / "overrides.yaml").write_text("- seed=1\n")
    status = [row["status"] for row in table(tmp_path)]
    assert status == [
        "failed: TrainingError: a | b\nmore",
        "interrupted",
        "running, or killed, since 2026-01-01T00:00:00+00:00",
        "finished without metrics.json",
        "failed before it began",
    ]
    assert "failed: TrainingError: a \\| b more " in write_tables(tmp_path)


NAMES = ("run.json", "metrics.json", "config.yaml")


@pytest.mark.parametrize("content", [b"{", b"\xff\xfe\x00", b"", b"[1]", b'{"test": 3}'])
def test_a_damaged_file_is_a_row_not_a_crash(tmp_path, content):
    _, *damaged = sweep(tmp_path, {"seed": 1}, *({} for _ in NAMES))
    for run, name in zip(damaged, NAMES, strict=True):
        (run / name).write_bytes(content)
    sound, *rows = table(tmp_path)
    assert sound["status"] == "finished"
    assert len(rows) == len(NAMES)
    for row, name in zip(rows, NAMES, strict=True):
        if (name, content) == ("config.yaml", b'{"test": 3}'):
            continue  # Nothing wrong with that, as far as a table goes.
        assert f"{name} " in row["status"]
        assert not row["status"].startswith("finished"), name
        assert row["psnr"] == ("" if name == "metrics.json" else "20.0"), name


def swept(folder: Path, *task: str) -> None:
    """Make a folder that of a sweep with Hydra's own sweeper."""
    target = "hydra._internal.core_plugins.basic_sweeper.BasicSweeper"
    sweeper = {"_target_": target, "params": None}
    hydra = {"sweeper": sweeper, "overrides": {"task": list(task)}}
    (folder / "multirun.yaml").write_text(yaml.safe_dump({"hydra": hydra}))


def test_jobs_without_a_run_are_rows(tmp_path):
    swept(tmp_path, "model=six_planes,nine_planes", "seed=range(0,2)", "a.b='x,y'")
    lines = ("model=six_planes", "seed=0", "a.b='x,y'")
    run = make(tmp_path / "0_a", model="six_planes", seed=0, overrides=lines)
    (run / ".hydra").mkdir()  # That of a command that was refused.
    (run / ".hydra" / "overrides.yaml").write_text("- seed=9\n")
    missing = [(row.name, row.status) for row in read_rows(tmp_path)[1:]]
    assert missing == [(f"job {number}", "missing: no run") for number in (1, 2, 3)]
    written = table(tmp_path)
    assert [row["model.name"] for row in written] == [*["six_planes"] * 2, *["nine_planes"] * 2]
    assert [row["seed"] for row in written] == ["0", "1", "0", "1"]
    assert "model.plane_set" not in written[0]


def test_jobs_in_nested_folders_and_begun_by_resume_are_not_missing(tmp_path):
    swept(tmp_path, "seed=0,1", "resume=auto")
    for seed in (0, 1):
        lines = (f"seed={seed}", "hydra.searchpath=[file://mine]")
        make(tmp_path / "six" / f"{seed}", seed=seed, overrides=lines)
    assert [row.status for row in read_rows(tmp_path)] == ["finished", "finished"]


def test_where_a_run_logs_keeps_no_seeds_apart(tmp_path):
    for seed, run in enumerate(sweep(tmp_path, {"seed": 0}, {"seed": 1})):
        logger, callbacks = {"csv": {"prefix": f"s{seed}"}}, {"keep": {"dirpath": f"{run}/mine"}}
        set_to(run, logger=logger, callbacks=callbacks)
    assert "Mean and standard deviation over seeds" in write_tables(tmp_path)


@pytest.mark.parametrize(
    "content",
    ["hydra: 3", "[", "hydra: {sweeper: {_target_: optuna.Sweeper}}", "hydra: {sweeper: null}"],
)
def test_an_unknown_sweeper_lists_no_jobs(tmp_path, content):
    make(tmp_path / "0")
    (tmp_path / "multirun.yaml").write_text(content)
    assert len(table(tmp_path)) == 1


def test_tables_can_go_elsewhere_but_are_of_a_folder_that_is_there(tmp_path):
    with pytest.raises(ConfigError, match="not a folder"):
        write_tables(tmp_path / "x")
    make(tmp_path / "sweep" / "0")
    write_tables(tmp_path / "sweep", tmp_path / "out")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["table.csv", "table.md"]
    assert not (tmp_path / "sweep" / "table.md").exists()


def test_a_run_is_a_table_of_itself(trained_run):
    row = read_rows(trained_run)[0]
    assert (row.name, row.status) == (trained_run.name, "finished")
    assert row.settings["model.name"] == "six_planes"
    assert {"psnr", "steps", "train_seconds", "parameters"} <= row.scores.keys()


def dnerf(run: Path, scene: str, psnr: float, model: str = "kplanes", by: str = "proposal") -> Path:
    """A run of a published model, by a sampler, on D-NeRF's data."""
    make(run, model=model, psnr=psnr)
    data = {"name": "dnerf", "scene": scene, "resolution": 400}
    set_to(run, data=data, model={"sampler": {"name": by}})
    return run


def published_lines(folder: Path) -> list[list[str]]:
    return cells(write_tables(folder).partition("beside published figures")[2])[2:]


def test_means_stand_beside_what_was_published(tmp_path):
    dnerf(tmp_path / "a", "lego", 24.0)
    dnerf(tmp_path / "b", "hook", 27.0)
    dnerf(tmp_path / "c", "lego", 25.0, model="six_planes", by="occupancy")
    entries = [e for e in read_published() if (e["model"], e["sampler"]) == ("kplanes", "proposal")]
    lines = published_lines(tmp_path)
    assert len(entries) >= 1
    assert [line[:5] for line in lines[:1]] == [["kplanes", "none", "proposal", "2", "25.50"]]
    for line, entry in zip(lines, entries, strict=False):
        assert line[7:-1] == [entry[n] for n in ("psnr", "ssim", "minutes", "scenes")]
        assert line[-1] == f"{entry['table']}, {entry['source']}"
    assert lines[0][6] == "1.0"  # Minutes: 2 s of preparation and 60.25 s of training.
    # There are no published figures for six planes with random initialisation.
    assert lines[-1][:5] == ["six_planes", "none", "occupancy", "1", "25.00"]
    assert set(lines[-1][7:]) == {""}


def test_published_figures_stand_beside_equal_resolutions_and_all_views_alone(tmp_path):
    for number, (resolution, views) in enumerate(((64, None), (128, None), (128, 10))):
        run = dnerf(tmp_path / f"{number}", "lego", 30.0, model="nine_planes")
        set_to(run, model={"resolution": resolution}, lrm={"name": "xlarge"}, data={"views": views})
    found = [(line[3], line[8], line[-1].split(",")[0]) for line in published_lines(tmp_path)]
    at_64 = [e for e in read_published() if e["model"] == "nine_planes" and e["lrm"] == "xlarge"]
    wanted = [(e["psnr"], e["table"]) for e in at_64 if e["resolution"] == "64"]
    settings = "data.views=None model.resolution=64"
    assert [f for f in found if f[0] == settings] == [(settings, *entry) for entry in wanted]
    (at_128,) = [e["psnr"] for e in at_64 if e["resolution"] == "128"]
    assert [f[1] for f in found if f[0] == "data.views=None model.resolution=128"] == [at_128]
    assert [f[1] for f in found if f[0] == "data.views=10 model.resolution=128"] == [""]


def named(folder: Path, *tables: str) -> None:
    """Make a folder a sweep that names published tables."""
    content = {"hydra": {"callbacks": {"table": {"published": list(tables)}}}}
    (folder / "multirun.yaml").write_text(yaml.safe_dump(content))


def test_a_named_table_is_shown_whole_whatever_the_data(tmp_path):
    make(tmp_path / "a", model="kplanes")
    assert "published" not in write_tables(tmp_path)
    named(tmp_path, "Table 1")
    text = write_tables(tmp_path)
    rows = [entry for entry in read_published() if entry["table"] == "Table 1"]
    assert len(rows) == 8
    for row in rows:
        assert f"| {row['method']} " in text
    assert "none of these runs has their settings" in text
    assert "NerfAcc" not in text
    # Of D-NeRF's data, K-Planes' own figures stand beside its own runs instead.
    shutil.rmtree(tmp_path / "a")
    dnerf(tmp_path / "a", "lego", 24.0)
    assert "| K-Planes " not in write_tables(tmp_path)
    assert "| 4D-GS " in write_tables(tmp_path)


def test_an_unknown_table_is_refused():
    for names in (["Table 9"], "Table 1", None):
        with pytest.raises(ConfigError, match=r"published=.*: must be a list of some of Table 1"):
            check_published(names)


def test_decompositions_and_their_mean_rank_stand_in_the_table(tmp_path):
    report = {"drift": 0.125, "low_rank_energy": 0.9, "sparse_energy": 0.05, "converged": True}
    runs = sweep(tmp_path, {}, {}, {"model": "kplanes"})
    for run, ranks in zip(runs, ((1, 2, 3), (4, 5, 9)), strict=False):
        found = {n: {**report, "rank": r} for n, r in zip(("xy", "xz", "yz"), ranks, strict=True)}
        found["unexplained"] = {"before": 1.0, "after": 0.5}
        set_to(run, "metrics.json", decomposition=found)
    named(tmp_path, "Rank")
    text = write_tables(tmp_path)
    rows = cells(text.partition("Decomposition of")[2])[2:]
    assert rows == [
        ["0", "six_planes", "1/2/3", "0.125", "90.00", "5.00", "true"],
        ["1", "six_planes", "4/5/9", "0.125", "90.00", "5.00", "true"],
    ]
    (published,) = [entry["rank"] for entry in read_published() if entry["table"] == "Rank"]
    assert f"Mean rank of the low-rank part: 4.00 over these 2 runs; published: {published}" in text


def test_the_protocol_stands_above_the_table(tmp_path):
    run = dnerf(tmp_path / "a", "lego", 24.0)
    trainer = {"max_steps": 30000, "max_seconds": None}
    set_to(run, trainer=trainer, model={"rays": {"background": "one"}})
    set_to(run, "run.json", device="RTX 3090", cpus=16)
    assert (
        "Scores of the test split. Protocol: data: dnerf · width, px: 400 · background: one · "
        "steps: 30000 · seconds: no limit · machine: RTX 3090, 16 CPU cores.\n"
    ) in write_tables(tmp_path)


def test_means_keep_runs_with_other_settings_apart(tmp_path):
    for weight, psnr in ((0.0, 26.0), (0.5, 24.0)):
        run = dnerf(tmp_path / f"{weight}", "lego", psnr)
        set_to(run, model={"loss": {"initial_weight": weight}})
    found = [line[3:6] for line in published_lines(tmp_path) if line[4]]
    weights = {"0.0": "26.00", "0.5": "24.00"}.items()
    assert sorted(found) == [[f"model.loss.initial_weight={w}", "1", psnr] for w, psnr in weights]


PRINTED = """
Table 1 gaussians_hexplane_published: none 34.09 0.981 24
Table 1 gaussians_spacetime_published: none 36.07 0.984 50
Table 1 : 36.13 0.985 50
Table 1 kplanes: none 31.71 0.971 52
Table 1 tensor4d: none 32.33 0.973 64
Table 1 tineuvox_b: none 32.67 0.973 28
Table 1 nine_planes: xlarge 33.67 0.980 34
Table 1 six_planes: xlarge 33.40 0.979 26
Table 2 six_planes: small 31.13 0.966, base 31.78 0.970, large 32.18 0.973, xlarge 33.40 0.979
Table 3 six_planes: small 31.13 0.969, base 31.78 0.971, large 32.18 0.972, xlarge 33.40 0.978
Table 3 nine_planes: small 32.04 0.972, base 32.54 0.975, large 32.54 0.974, xlarge 33.67 0.981
Table 4 six_planes: 64 33.40, 128 33.51, 256 33.55, 512 33.55
Table 4 nine_planes: 64 33.56, 128 33.65, 256 33.68, 512 33.67
"""
"""PSNR, SSIM and minutes that the paper prints, by LRM; those of Table 4 by texels, PSNR alone."""


def test_the_papers_figures_are_those_that_it_prints():
    found: dict[str, list[str]] = {}
    for entry in read_published():
        if not entry["table"].startswith("Table"):
            continue
        fourth = entry["table"] == "Table 4"
        names = ("resolution" if fourth else "lrm", "psnr", "ssim", "minutes")
        words = " ".join(filter(None, (entry[name] for name in names)))
        found.setdefault(f"{entry['table']} {entry['model']}", []).append(words)
        if entry["method"].startswith("X-Planes"):
            assert entry["method"] == f"X-Planes ({entry['model'].split('_')[0]})"
            assert fourth or entry["resolution"] == "64"
            assert not fourth or entry["lrm"] == "xlarge"
    lines = [f"{place}: {', '.join(words)}" for place, words in found.items()]
    assert lines == PRINTED.strip().splitlines()


def test_the_page_on_the_paper_quotes_them_where_they_stand():
    page = (Path(__file__).parents[2] / "docs" / "paper.md").read_text(encoding="utf-8")
    printed = dict(line.split(": ") for line in PRINTED.strip().splitlines())
    two, three = (
        ", ".join(words.split()[2] for words in printed[f"Table {n} six_planes"].split(", "))
        for n in (2, 3)
    )
    assert f"Table 2: {two}; Table 3: {three}, at the same PSNR" in page
    held = [place.split()[1] for place, words in printed.items() if "xlarge 33.67" in words]
    assert f"33.67 in Tables {' and '.join(held)}, 33.56 in Table 4" in page


def test_published_figures_name_their_source_and_models_that_exist():
    models = {path.stem for path in (CONF / "model").glob("*.yaml")}
    for entry in read_published():
        assert entry["source"]
        assert entry["model"] in {*models, ""}
        assert bool(entry["psnr"]) != bool(entry["rank"])
        assert 10 < float(entry["psnr"] or 20) < 50
        assert not entry["ssim"] or 0.5 < float(entry["ssim"]) < 1


def test_settings_of_jobs_that_never_began_are_no_columns(tmp_path):
    runs = sweep(tmp_path, {"resolution": 64}, {"resolution": 65})
    for run, enabled in zip(runs, (False, "${viewer}"), strict=True):
        set_to(run, callbacks={"viewer": {"enabled": enabled}})
    header = table(tmp_path)[0].keys()
    assert "model.resolution" in header
    assert not [name for name in header if "viewer" in name]
