"""The page "Ablations": what each part of the method is worth."""

import itertools
import math
import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from figures import dots, legend, panels, save
from runner import markdown
from sections import Case, Row, Section, number, trainings, value
from torch import Tensor
from torch.nn.functional import interpolate

from xplanes.decomposition import (
    decompose,
    space_planes,
    sparse_product_loss,
    time_planes,
    unexplained_energy,
)
from xplanes.fields.xplanes import PLANE_SETS

BUDGET = (
    *("trainer.max_steps=1000", "trainer.max_seconds=null", "trainer.accelerator=cpu"),
    *("data.resolution=100", "callbacks.evaluation.at=[]", "trainer.limit_val_batches=1"),
)

SAVINGS: dict[str, tuple[str, ...]] = {
    "all savings": (),
    "empty space off": ("model.sampler.skip_empty=false",),
    "occlusion off": ("model.sampler.skip_occluded=false",),
    "silhouettes off": ("model.sampler.silhouettes=false",),
    "background off": ("model.rays.skip_background=false",),
}
SAVINGS["all off"] = tuple(itertools.chain(*SAVINGS.values()))
SAVED = {
    "excavator": ("data.scene=excavator",),
    "topology": ("data=suite", "data.scene=topology"),
}


def savings() -> list[Case]:
    # Without a limit on samples, all runs see the same rays at the same step.
    equal = ("model.rays.per_batch=512", "model.rays.samples_per_batch=1000000")
    return [
        Case(
            f"{scene}, {name}",
            (*given, "lrm=none", *BUDGET, *equal, *off),
            quick=scene == "excavator" and name in ("all savings", "empty space off"),
            about={"scene": scene, "change": name},
        )
        for scene, given in SAVED.items()
        for name, off in SAVINGS.items()
    ]


def changes(rows: list[Row], key: str) -> dict[str, list[tuple[float, float] | None]]:
    """A value of each change less that of the scene's first row, by scene."""
    names = list(dict.fromkeys(row["change"] for row in rows))[1:]
    found = {}
    for scene in dict.fromkeys(row["scene"] for row in rows):
        own = [row for row in rows if row["scene"] == scene]
        known = {row["change"]: value(row, key) for row in own}
        first = known[own[0]["change"]]
        assert first is not None
        found[scene] = [
            None if (one := known.get(name)) is None else (one[0] - first[0], one[1])
            for name in names
        ]
    return found


def show_savings(rows: list[Row]) -> str:
    names = list(dict.fromkeys(row["change"] for row in rows))[1:]
    firsts = {row["scene"]: row["train"] for row in reversed(rows)}
    figure, (slower, better) = panels(2, 4.6)
    dots(slower, names, {
        scene: [
            (row["train"] / firsts[scene], 0.0)
            for row in rows
            if row["scene"] == scene and row["change"] in names
        ]
        for scene in firsts
    })  # fmt: skip
    dots(better, names, changes(rows, "psnr"))
    slower.axvline(1, color="0.3", linewidth=0.8)
    slower.set(xscale="log", xlabel="times the seconds with all savings")
    slower.set_xticks([0.8, 1, 2, 4], ["0.8", "1", "2", "4"])
    slower.minorticks_off()
    better.axvline(0, color="0.3", linewidth=0.8)
    better.set_xlabel("change of PSNR, dB")
    legend(figure, better)
    save(figure, "savings")
    columns = ("scene", "savings", "seconds", "times", "PSNR, dB", "SSIM", "samples per ray")
    lines = [
        (
            *(row["scene"], row["change"], number(row, "train", 1)),
            f"{row['train'] / firsts[row['scene']]:.2f}",
            *(number(row, "psnr"), number(row, "ssim", 3), number(row, "samples", 1)),
            *(number(row, key, 0, 100) for key in ("empty", "occluded", "background")),
            row["seeds"],
        )
        for row in rows
    ]
    columns += ("empty, %", "occluded, %", "background, %", "seeds")
    return f"![Seconds and PSNR with one saving off](savings.png)\n\n{markdown(columns, lines)}"


CAPTURES = {"phone": 60, "rig": 96}
"""Procedural captures of the suite and their numbers of training views."""

PARTS: dict[str, tuple[str, ...]] = {
    "default": (),
    "no background field": ("model.background=null",),
    "no smoothness of the background": ("model.background.total_variation=0",),
    "no smoothness of the planes": (
        *(
            "model.loss.total_variation_with_background=0",
            "model.loss.time_factor_with_background=0",
        ),
        "model.loss.time_smoothness=0",
    ),
    "threshold as without surroundings": ("model.sampler.threshold_with_background=0.001",),
    "all pixels drawn alike": ("model.rays.skip_background=false",),
    "light may pass the cube": ("model.loss.passing=0",),
    "no penalty on distortion": ("model.sampler.distortion=0",),
    "initialised from tiny": ("lrm=tiny",),
}


def captures() -> list[Case]:
    return [
        Case(
            f"{scene}, {name}",
            (
                *("data=suite", f"data.scene={scene}", f"data.train_views={views}", "lrm=none"),
                *(*BUDGET, *given),
            ),
            quick=scene == "phone" and name in ("default", "no background field"),
            about={"scene": scene, "change": name},
        )
        for scene, views in CAPTURES.items()
        for name, given in PARTS.items()
    ]


def show_captures(rows: list[Row]) -> str:
    names = list(dict.fromkeys(row["change"] for row in rows))[1:]
    figure, (axes,) = panels(1, 0.35 * len(names) + 1.4)
    dots(axes, names, changes(rows, "psnr"))
    axes.axvline(0, color="0.3", linewidth=0.8)
    axes.set_xlabel("PSNR less that of the default, dB")
    legend(figure, axes)
    save(figure, "captures")
    columns = ("scene", "change", "PSNR, dB", "PSNR of the object, dB", "SSIM", "seconds", "seeds")
    lines = [
        (
            *(row["scene"], row["change"], number(row, "psnr"), number(row, "psnr_foreground")),
            *(number(row, "ssim", 3), number(row, "train", 0), row["seeds"]),
        )
        for row in rows
    ]
    return f"![PSNR with one part changed](captures.png)\n\n{markdown(columns, lines)}"


FRAMES, CHANNELS, SIZE = 50, 32, 64
AXES = ((0, 1), (0, 2), (1, 2))
SEQUENCES: dict[str, tuple[Callable[[float], tuple[float, float, float]], float, float]] = {
    "orbiting": (lambda t: (0.6 * math.cos(6 * t), 0.6 * math.sin(6 * t), 0.3), 0.2, 0.0),
    "crossing, large": (lambda t: (1.4 * t - 0.7, 0.2, 0.4 * math.sin(3 * t)), 0.35, 0.0),
    "resting 60% of the time": (
        lambda t: (0.3 + 1.5 * min(0.0, t - 0.4), 0.8 * min(0.0, t - 0.4), -0.2),
        0.2,
        0.0,
    ),
    "waving in place": (lambda t: (0.25 * math.sin(9 * t), 0.0, 0.1 * math.cos(9 * t)), 0.25, 0.0),
    "orbiting, changing features": (
        lambda t: (0.6 * math.cos(6 * t), 0.6 * math.sin(6 * t), 0.3),
        0.2,
        1.0,
    ),
}
"""The path of a ball, its radius, and how often its features turn."""

STATIC = ("middle", "median", "mean")
STEPS = 400


def sequence(name: str) -> tuple[Tensor, Tensor]:
    """Triplanes [T, 3, C, H, W] of a ball before a background, and the background [3, C, H, W].

    The background has smooth random features with a root mean square of 1. The whole triplane
    flickers slowly, as predictions frame by frame do, and has noise.
    """
    generator = torch.Generator().manual_seed(7)
    trajectory, radius, turning = SEQUENCES[name]

    def smooth(cells: int) -> Tensor:
        coarse = torch.randn(3, CHANNELS, cells, cells, generator=generator)
        return interpolate(coarse, (SIZE, SIZE), mode="bicubic")

    background = smooth(8) + 0.3 * smooth(24)
    background /= background.square().mean().sqrt()
    flicker = 0.1 * smooth(6)
    colour, other = (1.5 * torch.randn(3, CHANNELS, 1, 1, generator=generator) for _ in range(2))
    grid = (torch.arange(SIZE) + 0.5) / SIZE * 2 - 1
    frames = []
    for frame in range(FRAMES):
        timestep = frame / (FRAMES - 1)
        centre = trajectory(timestep)
        angle = 2 * math.pi * turning * timestep
        features = math.cos(angle) * colour + math.sin(angle) * other
        planes = background + math.sin(2 * math.pi * 1.3 * timestep) * flicker
        for index, (first, second) in enumerate(AXES):
            distance = (grid - centre[first]) ** 2 + (grid[:, None] - centre[second]) ** 2
            cover = torch.sigmoid(8 * (1 - distance.sqrt() / radius))
            texture = 1 + 0.2 * torch.sin(15 * (grid - centre[first]))
            planes[index] = (1 - cover) * planes[index] + cover * features[index] * texture
        frames.append(planes + 0.05 * torch.randn(planes.shape, generator=generator))
    return torch.stack(frames), background


def trained(planes: Tensor, sparse: Tensor, plane_set: str) -> float:
    """Unexplained energy after steps of Adam on the product loss, four random frames each."""
    planes = planes.clone().requires_grad_()
    optimizer = torch.optim.Adam([planes], lr=0.01)
    generator = torch.Generator().manual_seed(0)
    for _ in range(STEPS):
        frames = torch.randint(len(sparse), (4,), generator=generator)
        optimizer.zero_grad()
        sparse_product_loss(planes, sparse, frames, rows=PLANE_SETS[plane_set]).backward()
        optimizer.step()
    return unexplained_energy(planes.detach(), sparse, rows=PLANE_SETS[plane_set])


def measure_conversion(work: Path, quick: bool) -> list[Row]:
    """Errors of the space planes, and unexplained energies of the time planes, by sequence."""
    warnings.simplefilter("ignore")
    rows = []
    for name in list(SEQUENCES)[: 1 if quick else None]:
        triplanes, truth = sequence(name)
        parts = decompose(triplanes, progress=False)
        row: Row = {"case": name, "rank": parts.reports["xy"]["rank"]}
        sources = {static: (parts.low_rank, static) for static in STATIC}
        for option, (source, static) in (sources | {"input": (triplanes, "median")}).items():
            planes = space_planes(source, static=static).permute(0, 3, 1, 2)
            row[option] = ((planes - truth).norm() / truth.norm()).item()
        for plane_set in ("six", "nine"):
            first = time_planes(parts.sparse, plane_set=plane_set, dynamic="rank1")
            row[plane_set] = unexplained_energy(first, parts.sparse, rows=PLANE_SETS[plane_set])
            generator = torch.Generator().manual_seed(0)
            random = time_planes(
                parts.sparse, plane_set=plane_set, dynamic="random", generator=generator
            )
            row[f"{plane_set} trained"] = trained(random, parts.sparse, plane_set)
        rows.append(row)
    return rows


def show_conversion(rows: list[Row]) -> str:
    names = [row["case"] for row in rows]
    figure, (static, dynamic) = panels(2, 5.6)
    labels = {f"{option} of L": option for option in STATIC} | {"median of the input": "input"}
    dots(static, names, {label: [value(row, key) for row in rows] for label, key in labels.items()})
    static.set_xlabel("space planes: relative error")
    static.legend(loc="upper center", bbox_to_anchor=(0.3, -0.2), ncols=2, frameon=False)
    static.set_xlim(left=0)
    kinds = {
        f"{planes} planes, {words}": f"{planes}{key}"
        for planes in ("six", "nine")
        for words, key in (("rank 1", ""), (f"random, {STEPS} steps", " trained"))
    }
    dots(dynamic, names, {label: [value(row, key) for row in rows] for label, key in kinds.items()})
    dynamic.set_xlabel("time planes: share of the energy of S not explained")
    dynamic.legend(loc="upper center", bbox_to_anchor=(0.3, -0.2), ncols=2, frameon=False)
    dynamic.set_xlim(left=0)
    save(figure, "conversion")
    columns = ("sequence", *labels, "rank of L, xy", *kinds)
    lines = [
        (
            *(row["case"], *(number(row, key, 3) for key in labels.values()), row["rank"]),
            *(number(row, key, 3) for key in kinds.values()),
        )
        for row in rows
    ]
    return f"![Errors of the options](conversion.png)\n\n{markdown(columns, lines)}"


def conversion_settings() -> dict[str, Row]:
    size = {"frames": FRAMES, "channels": CHANNELS, "texels": SIZE, "steps": STEPS}
    return dict.fromkeys(SEQUENCES, size)


SECTIONS: tuple[Section, ...] = (
    trainings(
        savings(),
        name="savings",
        show=show_savings,
        checks={"psnr": 0.02, "train": 0.3},
    ),
    trainings(
        captures(),
        name="captures",
        show=show_captures,
    ),
    Section(
        name="conversion",
        settings=conversion_settings,
        measure=measure_conversion,
        show=show_conversion,
        checks={"median": 0.05, "six": 0.05},
    ),
)
