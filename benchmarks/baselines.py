"""The page "Against baselines": other methods after equal seconds, and later."""

import json
from dataclasses import replace
from pathlib import Path

import torch
from figures import curves, panels, save
from runner import markdown
from sections import DATA, Case, Row, Section, number, placed, read_record, trainings

from xplanes import SceneDataModule
from xplanes.files import read_json, write_text
from xplanes.metrics import psnr, ssim

SECONDS, LONGER = 60, 240
EVALUATED = "callbacks.evaluation.at=[0.05,0.1,0.25,0.5,0.75]"
"""Shares of the budget after which two views are scored."""

KPLANES = (
    *("model=kplanes", "model/sampler=occupancy", "model.scales=[2]", "model.warmup_steps=50"),
    *("model.rays.per_batch=1024", "model.rays.samples_per_batch=8192"),
    *("model.rays.skip_background=true", "model.rays.background=white"),
)
"""K-Planes at a size that learns within minutes on a CPU."""

TINEUVOX = ("model=tineuvox_s", "model.rays.per_batch=1024")

OWN = ("lrm=none",)
GAUSSIANS = ("model=gaussians_hexplane", "lrm=none")
HELD_OUT = ("data=dnerf", "data.root={held_out}", "data.scene=lego")


def budget(seconds: int, *more: str) -> tuple[str, ...]:
    """Ends a run after so many seconds of training on the CPU."""
    limits = (f"trainer.max_seconds={seconds}", "trainer.max_steps=1000000")
    return (*limits, "trainer.accelerator=cpu", *more)


def lego() -> list[Case]:
    scored = (EVALUATED, "trainer.limit_val_batches=2")
    return [
        Case("six planes", (*HELD_OUT, *OWN, *budget(SECONDS, *scored)), quick=True),
        Case("4D-GS", (*HELD_OUT, *GAUSSIANS, *budget(SECONDS, *scored)), seeds=1),
        Case("K-Planes, smaller", (*HELD_OUT, *KPLANES, *budget(LONGER, *scored)), seeds=1),
        Case(
            "TiNeuVox-S",
            (*HELD_OUT, *TINEUVOX, *budget(LONGER, *scored)),
            seeds=1,
        ),
    ]


def hold_out(folder: Path, out: Path) -> None:
    """Lego with every eighth training view, of all times and directions, held out for scoring.

    Args:
        folder: D-NeRF's scene.
        out: A scene whose images are those of ``folder``.
    """
    whole = read_json(folder / "transforms_train.json")
    parts = {"train": [], "test": []}
    for place, frame in enumerate(whole["frames"]):
        parts["test" if place % 8 == 4 else "train"].append(frame)
    out.mkdir(parents=True, exist_ok=True)
    if not (out / "train").exists():
        (out / "train").symlink_to((folder / "train").absolute(), target_is_directory=True)
    for split, frames in parts.items():
        text = json.dumps(whole | {"frames": frames})
        write_text(out / f"transforms_{split}.json", text)


def show_lego(rows: list[Row]) -> str:
    figure, (axes,) = panels(1, 3.4)
    curves(axes, {row["case"]: [point for point in row["curve"] if point[0] > 0] for row in rows})
    axes.set_xscale("log")
    axes.set_xticks([3, 10, 30, 60, 240])
    axes.xaxis.set_major_formatter("{x:g}")
    axes.minorticks_off()
    axes.set(xlabel="seconds of training, one core", ylabel="PSNR of two views, dB")
    save(figure, "lego")
    columns = (
        "method",
        "PSNR, dB",
        "SSIM",
        "seconds",
        "steps",
        "parameters",
        "memory, GB",
        "seeds",
    )
    lines = [
        (
            row["case"],
            *(number(row, "psnr"), number(row, "ssim", 3), number(row, "train", 0)),
            *(number(row, "steps", 0), f"{row['parameters'] / 1e6:.1f} M"),
            *(number(row, "gigabytes", 1), row["seeds"]),
        )
        for row in rows
    ]
    return f"![PSNR of lego against seconds](lego.png)\n\n{markdown(columns, lines)}"


SCENES = {
    "`topology_test`": ("data=suite", "data.scene=topology_test"),
    "`texture_test`": ("data=suite", "data.scene=texture_test"),
    "toy on a table": ("data=blender", "data.root={real}", "data.scene=toy", "data.resolution=400"),
    "hand over books": (
        *("data=nerfstudio", "data.root={real}", "data.scene=hand", "data.resolution=null"),
    ),
    "fly on a ball": (
        *("data=multicamera", "data.root={real}", "data.scene=fly", "data.test_cameras=[cam1]"),
        "data.resolution=480",
    ),
}
"""Test scenes of the suite, at 200 pixels, and real captures."""

DISTORTED = ("toy on a table",)
"""Captures with lens distortion, which Gaussians cannot rasterise."""

BOXED = ("toy on a table", "hand over books")
"""Captures whose scene lies in TiNeuVox's fixed box around the origin."""

MOVING_CAMERA = "hand over books"
"""The capture of a single moving camera."""

BLENDED = "two nearest frames, blended"


def scenes() -> list[Case]:
    found = []
    for scene, given in SCENES.items():
        about = {"scene": scene, "method": "six planes"}
        ends = budget(SECONDS, "callbacks.evaluation.at=[]", "trainer.limit_val_batches=1")
        name = f"{scene}, six planes"
        case = Case(name, (*given, *OWN, *ends), seeds=3, about=about)
        found.append(replace(case, quick="topology" in scene))
        others = {} if scene in DISTORTED else {"4D-GS": GAUSSIANS}
        if "suite" not in given[0]:
            others |= {"K-Planes, smaller": KPLANES}
        if scene in BOXED:
            others |= {"TiNeuVox-S": TINEUVOX}
        for method, options in others.items():
            about = {"scene": scene, "method": method}
            found.append(Case(f"{scene}, {method}", (*given, *options, *ends), 1, about=about))
    return sorted(found, key=lambda case: case.about["method"] != "six planes")


def blended(scene: str) -> Row:
    """Scores of the mean of the two training images that are nearest in time to each test view.

    For a single camera that moves, what a method must beat to mean anything.
    """
    data = SceneDataModule.compose(*placed(SCENES[scene]))
    train, test = data.read_split("train"), data.read_split(data.test_split)
    scores = []
    for index, at in enumerate(test.times):
        near = (train.times - at).abs().argsort(stable=True)[:2].tolist()
        first, second = (train.composite(view, torch.ones(3)) for view in near)
        truth = test.composite(index, torch.ones(3))
        scores.append([measured((first + second) / 2, truth) for measured in (psnr, ssim)])
    found = torch.tensor(scores).mean(dim=0).tolist()
    about = {"scene": scene, "method": BLENDED, "seeds": 1}
    return {"case": f"{scene}, {BLENDED}", **about, "psnr": found[0], "ssim": found[1]}


def show_scenes(rows: list[Row]) -> str:
    columns = ("scene", "method", "PSNR, dB", "SSIM", "steps", "memory, GB", "seeds")
    rows = sorted(rows, key=lambda row: list(SCENES).index(row["scene"]))
    lines = [
        (
            *(row["scene"], row["method"], number(row, "psnr"), number(row, "ssim", 3)),
            *(number(row, "steps", 0), number(row, "gigabytes", 1), row["seeds"]),
        )
        for row in rows
    ]
    return markdown(columns, lines)


def summary() -> str:
    """The table of README.md: X-Planes and 4D-GS after equal seconds."""
    found: dict[str, dict[str, Row]] = {}
    for name, scene in (("lego", "lego of D-NeRF, every eighth training view"), ("scenes", "")):
        for row in (read_record(name) or {"rows": []})["rows"]:
            own = found.setdefault(row.get("scene", scene), {})
            own[row.get("method", row["case"])] = row
    columns = ("scene", "PSNR, dB", "SSIM", "seeds", "4D-GS: PSNR, dB", "4D-GS: SSIM")
    lines = [
        (
            scene,
            *(number(rows["six planes"], "psnr"), number(rows["six planes"], "ssim", 3)),
            rows["six planes"]["seeds"],
            *(number(rows.get("4D-GS", {}), "psnr"), number(rows.get("4D-GS", {}), "ssim", 3)),
        )
        for scene, rows in found.items()
    ]
    return markdown(columns, lines) if lines else "Not measured yet."


SUMMARIES = {"minute": summary}
SECTIONS: tuple[Section, ...] = (
    trainings(
        lego(),
        before=lambda: hold_out(DATA["dnerf"] / "lego", DATA["held_out"] / "lego"),
        name="lego",
        show=show_lego,
    ),
    trainings(
        scenes(),
        besides=lambda: [blended(MOVING_CAMERA)],
        name="scenes",
        show=show_scenes,
    ),
)
