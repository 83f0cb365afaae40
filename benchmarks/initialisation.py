"""The page "What the LRM gives": its lead over random initialisation, and what it consists of."""

import subprocess
import sys
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import controls
from baselines import GAUSSIANS, HELD_OUT, KPLANES, hold_out
from figures import curves, dots, legend, panels, save
from runner import markdown
from sections import DATA, WORK, Case, Row, Section, number, trainings, value

DATA["oracles"] = WORK / "oracles"
DEMOS = ("excavator", "balls")
"""Scenes with the video of a fixed camera."""
FEW, ALL = 5, 50


class Kind(NamedTuple):
    """An initialisation: what it consists of, and its settings or the control of its LRM."""

    words: str
    overrides: tuple[str, ...] = ()
    control: str = ""
    every: bool = False


KINDS = {
    "random": Kind("random planes and decoder", ("lrm=none",), every=True),
    "decoder alone": Kind("random planes, the LRM's decoder", control="random_planes"),
    "mean triplane": Kind(
        "mean of the LRM's triplanes of 64 training objects", control="mean", every=True
    ),
    "another scene": Kind("triplanes of another scene's video", control="other_scene"),
    "one frame": Kind("the middle frame's triplane at all times", control="one_frame"),
    "fresh decoder": Kind(
        "the LRM's planes, a random decoder", control="fresh_decoder", every=True
    ),
    "without S": Kind(
        "robust PCA, but random time planes and no L_r",
        ("lrm=tiny", "decomposition.dynamic=random", "model.loss.sparse_weight=0.0"),
    ),
    "median": Kind("static part: median over time, no robust PCA", control="median"),
    "not regularised": Kind(
        "neither L_r nor the distance term", ("lrm=tiny", *controls.NOT_REGULARISED)
    ),
    "LRM": Kind("the method", ("lrm=tiny",), every=True),
    "oracle": Kind("triplanes fitted to true views", control="oracle", every=True),
}


def scene_of(name: str) -> tuple[str, ...]:
    if name == "lego":
        return (*HELD_OUT, "data.resolution=100")
    return (f"data.scene={name}", "data.resolution=100", "data.train_on_video=true")


def within(seconds: int, *plugins: str) -> tuple[str, ...]:
    """So many seconds for preparation and training together; nothing comes from the cache."""
    return (
        *(f"plugins=[{','.join(('total_time', *plugins))}]", "preparation.cache=null"),
        "+callbacks.total_time._target_=total_time.TotalTime",
        *(f"trainer.max_seconds={seconds}", "trainer.max_steps=1000000", "trainer.accelerator=cpu"),
        "callbacks.evaluation.at=[0.0]",
    )


def cases() -> list[Case]:
    found = []
    for views in (FEW, ALL):
        for name, start in KINDS.items():
            for scene in (*DEMOS, "lego"):
                if (views == ALL and not start.every) or (scene, name) == ("lego", "oracle"):
                    continue
                own, plugins = start.overrides, ()
                if start.control:
                    plugins = ("controls",)
                    own = controls.overrides(start.control, oracle_of(scene, start.control))
                some = () if views == ALL else (f"data.views={views}",)
                found.append(
                    Case(
                        f"{scene}, {views} views, {name}",
                        (*scene_of(scene), *some, *within(20, *plugins), *own),
                        seeds=1,
                        quick=scene == "excavator" and views == FEW and name in ("random", "LRM"),
                        about={"scene": scene, "views": views, "start": name},
                    )
                )
    return found


def oracle_of(scene: str, control: str) -> Path | None:
    return Path(f"{{oracles}}/{scene}.safetensors") if control == "oracle" else None


def hold_out_views() -> None:
    """Hold out views of lego."""
    hold_out(DATA["dnerf"] / "lego", DATA["held_out"] / "lego")


def before() -> None:
    """Hold out views of lego, and fit the triplanes of the oracle."""
    hold_out_views()
    for scene in DEMOS:
        file = DATA["oracles"] / f"{scene}.safetensors"
        if not file.is_file():
            script = Path(__file__).with_name("oracle.py")
            subprocess.run([sys.executable, str(script), scene, str(file)], check=True)


def table(rows: list[Row], views: int) -> str:
    """PSNR of each initialisation by scene, and its mean lead over random initialisation."""
    known = {(row["start"], row["scene"]): row for row in rows if row["views"] == views}
    scenes = list(dict.fromkeys(scene for _, scene in known))
    lines = []
    for name in dict.fromkeys(start for start, _ in known):
        own = [known.get((name, scene), {}) for scene in scenes]
        leads = [
            row["psnr"] - known["random", scene]["psnr"]
            for row, scene in zip(own, scenes, strict=True)
            if row
        ]
        cells = [number(row, "psnr") for row in own]
        lead = "" if name == "random" else f"{fmean(leads):+.2f}"
        lines.append((name, KINDS[name].words, *cells, lead))
    return markdown(("initialisation", "what it is", *scenes, "mean lead, dB"), lines)


def show(rows: list[Row]) -> str:
    few = [row for row in rows if row["views"] == FEW]
    names = list(dict.fromkeys(row["start"] for row in few))[1:]
    leads: dict[str, list[tuple[float, float] | None]] = {}
    for scene in dict.fromkeys(row["scene"] for row in few):
        own = {row["start"]: value(row, "psnr") for row in few if row["scene"] == scene}
        random = own["random"]
        assert random is not None
        leads[scene] = [
            None if (one := own.get(name)) is None else (one[0] - random[0], one[1])
            for name in names
        ]
    figure, (axes,) = panels(1, 0.35 * len(names) + 1.4)
    dots(axes, names, leads)
    axes.axvline(0, color="0.3", linewidth=0.8)
    axes.set_xlabel(f"lead over random initialisation with {FEW} views, dB")
    legend(figure, axes, 3)
    save(figure, "controls")
    return (
        f"![Lead of each initialisation over a random one](controls.png)\n\nWith {FEW} views:\n\n"
        f"{table(rows, FEW)}\n\nWith all views:\n\n{table(rows, ALL)}"
    )


FEWEST = (3, 5, 10)
TESTED = {**{name: scene_of(name) for name in ("walker", "windmill")}, "lego": scene_of("lego")}
METHODS = {
    "six planes, tiny": ("lrm=tiny",),
    "six planes, random": ("lrm=none",),
    "4D-GS": GAUSSIANS,
    "K-Planes, smaller": KPLANES,
    "TiNeuVox, reduced": ("model=tineuvox_reduced",),
}


def few_cases() -> list[Case]:
    found = []
    for (scene, given), views, (method, own) in product(TESTED.items(), FEWEST, METHODS.items()):
        about = {"scene": scene, "views": views, "method": method}
        name = f"{scene}, {views} views, {method}"
        overrides = (*given, f"data.views={views}", *within(30), "trainer.limit_val_batches=1")
        seeds = 3 if method.startswith("six") else 1
        found.append(Case(name, (*overrides, *own), seeds, about=about))
    return found


def show_few(rows: list[Row]) -> str:
    known = {(row["scene"], row["method"], row["views"]): row for row in rows}
    figure, places = panels(len(TESTED), 2.1 * len(TESTED), sharex=True)
    for axes, scene in zip(places, TESTED, strict=True):
        lines = {
            name: [
                (views, *found)
                for views in FEWEST
                if (found := value(known.get((scene, name, views)), "psnr")) is not None
            ]
            for name in METHODS
        }
        curves(axes, {name: line for name, line in lines.items() if line})
        axes.set(title=scene, ylabel="PSNR, dB", xticks=FEWEST)
    places[-1].set_xlabel("training views")
    save(figure, "few_views")
    ours = ("six planes, tiny", "six planes, random")
    body = []
    for scene, views in product(TESTED, FEWEST):
        own = {name: known.get((scene, name, views), {}) for name in METHODS}
        tiny, random = (own[name].get("psnr") for name in ours)
        lead = "" if tiny is None or random is None else f"{tiny - random:+.2f}"
        body.append((scene, views, *(number(row, "psnr") for row in own.values()), lead))
    columns = ("scene", "views", *(f"{name}, dB" for name in METHODS), "`tiny` leads by, dB")
    return f"![PSNR against the number of views](few_views.png)\n\n{markdown(columns, body)}"


SECTIONS: tuple[Section, ...] = (
    trainings(cases(), before=before, name="controls", show=show),
    trainings(few_cases(), before=hold_out_views, name="few_views", show=show_few),
)
