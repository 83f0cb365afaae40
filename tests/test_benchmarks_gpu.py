"""The GPU benchmark without a GPU: what it measures, leaves out, survives and writes."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from tests import inside
from tests.warm import ROOT, python
from xplanes.files import read_rows

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(torch.cuda.is_available(), reason="for machines without a GPU"),
]


@pytest.fixture
def gpu():
    with inside.benchmark("gpu") as module:
        yield module


def measure(gpu, folder, *options, code=0):
    """Run the benchmark, and read its page."""
    assert gpu.main(["--out", str(folder), *options]) == code
    return (folder / "gpu.md").read_text(encoding="utf-8")


def rows(folder):
    return {(row["part"], row["name"]): row for row in read_rows(folder / "gpu.csv")}


@pytest.fixture
def faked(gpu, monkeypatch):
    """Parts that find something at once; ``faked.fail`` and ``faked.begun`` are part names."""
    state = SimpleNamespace(fail={}, begun=[], psnr={"GPU": 22.0, "CPU": 22.1}, seconds=0.0)

    def run_part(part, args, *, gpu: bool, left: float):
        state.begun.append(part.name)
        record = module.Record(args.work / "record.json", device="A GPU, 80 GiB")
        if part.section == "kernels":
            cells = {
                "kernels: values": (1e-6, "relative"),
                "kernels: gradients": (2e-6, "relative"),
            }
            record.add("accuracy", part.row, cells)
            for label, gain in (("forward", 3.0), ("backward", 4.0)):
                cells = {"kernels": (10.0, "us"), "times faster": (gain, "times")}
                row = f"{part.row}, {module.POINTS[-1]} points, {label}"
                record.add("kernel time", row, cells)
        elif part.section == "step":
            record.add("step", "whole", {"time a step": (1500.0, "us"), "share": (100.0, "%")})
        elif part.section == "preparation":
            record.add("preparation", "LRM", {"time": (12.0, "ms")})
        else:
            psnr = state.psnr[part.row.split(", ")[1]] if part.section == "training" else 30.0
            known = {"PSNR": (psnr, "dB"), "SSIM": (0.9, ""), "steps/s": (50.0, "steps/s")}
            names = module.COLUMNS[part.section]
            record.add(part.section, part.row, {n: c for n, c in known.items() if n in names})
        record.error = state.fail.get(part.name, "")
        clock.now += state.seconds
        return module.Outcome(part, module.Record.load(record.path) if not record.error else record)

    module, clock = gpu, SimpleNamespace(now=gpu.BEGAN)
    monkeypatch.setattr(gpu.time, "monotonic", lambda: clock.now)
    monkeypatch.setattr(gpu, "run_part", run_part)
    return state


@pytest.fixture
def found_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)


@pytest.fixture
def lego(tmp_path):
    folder = tmp_path / "lego"
    folder.mkdir()
    (folder / "transforms_train.json").touch()
    return folder


def test_with_a_gpu_all_parts_run_and_the_page_compares(gpu, faked, found_gpu, lego, tmp_path):
    page = measure(gpu, tmp_path, "--lego", str(lego))
    assert faked.begun == [part.name for part in gpu.PARTS]
    assert "A GPU, 80 GiB" in page
    assert "22.00 dB on the GPU, 22.10 dB on the CPU" in page
    assert "difference of -0.10 dB is within 0.3 dB" in page
    assert "forward: 3.0 to 3.0 times as fast as torch" in page
    assert "lego at 400 px, 60 s: 30.00 dB, SSIM 0.9000" in page
    assert "Left out" not in page
    assert "Failed" not in page
    figures = rows(tmp_path)
    assert figures["training", "random, GPU: PSNR"]["value"] == "22"
    assert figures["difference", "random: PSNR, GPU minus CPU"]["value"] == "-0.1"
    assert {row["unit"] for row in figures.values()} <= set(gpu.FORMATS)


def test_devices_that_disagree_are_said_to(gpu, faked, found_gpu, tmp_path):
    faked.psnr["GPU"] = 20.0
    page = measure(gpu, tmp_path, "--only", "training")
    assert "difference of -2.10 dB is not within 0.3 dB" in page


def test_a_part_that_fails_stops_no_other_and_sets_the_exit_code(gpu, faked, found_gpu, tmp_path):
    faked.fail["training (random, GPU)"] = "RuntimeError: no memory"
    page = measure(gpu, tmp_path, "--lego", str(tmp_path / "lego"), code=1)
    assert "* training (random, GPU): RuntimeError: no memory\n" in page
    assert faked.begun[-1] == gpu.PARTS[-1].name
    assert "xplanes download dnerf" in page  # There is no lego.


def test_parts_that_do_not_fit_into_the_minutes_are_left_out(gpu, faked, found_gpu, tmp_path):
    faked.seconds = 60.0
    page = measure(gpu, tmp_path, "--minutes", "4")
    # Of 225 seconds three parts leave 45: enough for one that needs 40, not for one that needs 60.
    assert len(faked.begun) == 4, faked.begun
    assert "Too little was left of the minutes: training (random, GPU); " in page


def test_without_a_gpu_the_page_says_what_is_missing(gpu, faked, tmp_path):
    page = measure(gpu, tmp_path)
    begun = {part.name for part in gpu.PARTS if not part.needs_gpu}
    assert set(faked.begun) == begun
    assert "No CUDA GPU was found: training (random, GPU); " in page
    assert "Triton's interpreter" in page


def test_errors_of_kernels_are_seen(gpu, tmp_path):
    pytest.importorskip("triton", reason="triton is not installed")
    record = gpu.Record(tmp_path / "record.json")
    sizes = gpu.Sizes(gpu.RAY, 2, 8, 4, torch.device("cpu"), reach=1.2)
    gpu.compare(record, "nine planes", lambda sizes: gpu.lookup_case("nine", sizes), sizes)
    gpu.compare(record, "products", gpu.product_case, sizes)
    assert not record.error
    assert all(0 <= figure.value < gpu.TOLERANCE for figure in record.figures)

    def broken(sizes):
        case = gpu.product_case(sizes)
        return gpu.Case(case.leaves, lambda leaves: 1.01 * case.twin(leaves), case.twin, case.least)

    gpu.compare(record, "products", broken, sizes)
    assert "products, 2 channels, 8 texels" in record.error
    assert gpu.Record.load(record.path) == record


def test_marching_agrees_with_its_twin(gpu, tmp_path):
    pytest.importorskip("triton")
    record = gpu.Record(tmp_path / "record.json")
    (part,) = (part for part in gpu.PARTS if part.row == "marching")
    part.work(record, part, None)
    assert not record.error
    assert [figure.table for figure in record.figures] == ["accuracy"]


@pytest.fixture
def begin(gpu, monkeypatch, tmp_path):
    """Runs a part whose process is another program."""
    real = subprocess.run

    def begin(part, program, left):
        def other(command, **options):
            return real([sys.executable, "-c", program], **options)

        monkeypatch.setattr(gpu, "PARTS", (part,))
        monkeypatch.setattr(subprocess, "run", other)
        args = SimpleNamespace(work=tmp_path, lego=Path("lego"))
        return gpu.run_part(part, args, gpu=True, left=left)

    return begin


def test_a_process_that_ends_early_leaves_one_line(gpu, begin, capsys):
    program = "print('first'); print('out of memory'); raise SystemExit(3)"
    outcome = begin(gpu.PARTS[0], program, 100)
    assert outcome.record.error == "ended with code 3, last line: out of memory"
    assert "first" in capsys.readouterr().err


@pytest.mark.parametrize(("limit", "failed"), [(1.0, True), (50.0, False)])
def test_a_part_that_takes_too_long_is_stopped(gpu, begin, limit, failed):
    part = gpu.Part("kernels", "slow", limit=limit)
    outcome = begin(part, "import time; time.sleep(60)", 1.0)
    assert outcome.record.error == ("stopped after 1 s" if failed else "")
    assert outcome.left_out == ("" if failed else "The minutes ran out 1 s after it had begun")


@pytest.mark.slow
def test_the_script_runs_without_a_gpu(tmp_path):
    pytest.importorskip("triton", reason="triton is not installed")
    done = python(str(ROOT / "benchmarks" / "gpu.py"), "--out", str(tmp_path))
    assert (tmp_path / "gpu.md").read_text(encoding="utf-8") in done.stdout
    figures = rows(tmp_path)
    assert float(figures["training", "random, CPU: PSNR"]["value"]) > 20
    errors = {
        name: float(row["value"]) for (part, name), row in figures.items() if part == "accuracy"
    }
    assert max(errors.values()) < 1e-4
    ours = {name.split(",")[0] for name in errors if "kernels: gradients" in name}
    assert ours == {"six planes", "nine planes", "products", "compositing"}
