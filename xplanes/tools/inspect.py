"""`xplanes inspect`: reads a capture and describes it in a table, with warnings."""

import functools
import math
import shlex
import warnings
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from xplanes.components import build, class_of, plugins
from xplanes.config import compose_plain, group_options, quoted, settings_and_paths
from xplanes.errors import ConfigError, SceneError, some
from xplanes.evaluation.findings import (
    Finding,
    calibrations,
    camera_findings,
    time_gaps,
    time_steps,
)
from xplanes.models.base import ModelSettings
from xplanes.process import train_command
from xplanes.rendering.sampler import Site
from xplanes.scenes.cameras import image_plane
from xplanes.scenes.frame import Frame, pixels_across
from xplanes.scenes.lenses import COEFFICIENTS, Lenses, LensModel
from xplanes.scenes.source import SceneSettings
from xplanes.scenes.views import Scene, Views
from xplanes.tools.image_findings import ImageFacts, image_facts, image_findings, texel_findings
from xplanes.tools.tabulate import markdown

CONSEQUENCES = {"axes": ("cut",), "scale": ("cut", "texels"), "astray": ("cut",)}
"""Findings that are consequences of another one, and not shown with it."""

ARCHIVES = (".zip", ".tar", ".gz", ".tgz", ".xz", ".7z", ".rar")  # Endings of archives.

STAMPED = "; programs write it for static scenes as well: data.static=true if nothing moves"
"""What is said of times from "timestamp"."""

NATIVE = "data.resolution=null"  # The setting that reads images at their native size.


@dataclass(frozen=True)
class Choice:
    """The settings with which a capture is read.

    Attributes:
        overrides: Settings of train.py that read the same capture.
        scene: The settings of the scene.
        model: The settings of the model, for the field's frame and the resolution of its planes.
        usual_width: Width of the images in the format's YAML file, if the native size is read by
            default instead; None otherwise.
    """

    overrides: tuple[str, ...]
    scene: SceneSettings
    model: ModelSettings
    usual_width: int | None = None


@dataclass(frozen=True)
class Capture:
    """A capture that was read.

    Attributes:
        choice: The settings with which it was read.
        scene: The scene.
        frame: The field's frame; None if it cannot be determined, for the reason in ``problem``.
        problem: Empty if there is a frame.
        images: Statistics of the pixels of each split's images.
        findings: Possible problems.
        texels: Texels along an axis of the planes; None for fields without planes.
        pixels_per_texel: Pixels of training images that a texel covers; None without planes.
    """

    choice: Choice
    scene: Scene
    frame: Frame | None
    problem: str
    images: Mapping[str, list[ImageFacts]]
    findings: tuple[Finding, ...]
    texels: int | None
    pixels_per_texel: float | None


@dataclass(frozen=True)
class CameraGroup:
    """The views of one physical camera, judged by poses and lenses.

    Attributes:
        name: Folder of the views if it distinguishes the cameras, else a number.
        indices: Indices of the views.
        fixed: Whether the camera is static.
    """

    name: str
    indices: list[int]
    fixed: bool


def choose(arguments: Sequence[str]) -> Choice:
    """The settings of a capture, from the command line or from the format of a folder.

    Args:
        arguments: A folder, whose images are read at their native size by default; settings of
            train.py; or both.

    Raises:
        ConfigError: If the settings are invalid, or several formats match.
        SceneError: If there is no such folder, or no format matches.
    """
    usual_width = None
    changed, folders = settings_and_paths(arguments)
    if len(folders) > 1:
        raise ConfigError(f"{folders[1]}: give one folder, and settings as key=value")
    if folders:
        folder = folders[0] if folders[0].name not in ("", "..") else folders[0].resolve()
        if not folder.is_dir():
            raise SceneError(f"{folder} is not a folder. Give the folder of a scene")
        given, data = {text.partition("=")[0] for text in changed}, []
        if "data" not in given:
            folder, option = _recognised(folder, changed)
            data = [f"data={option}"]
        place = [*data, *_place(folder)]
        if "data.resolution" not in given:
            usual_width = compose_plain("train", [*place, *changed])["data"]["resolution"]
            place.append(NATIVE)
        changed = [*place, *changed]
    plain = compose_plain("train", changed)
    with plugins(plain.get("plugins") or []):
        scene = build(plain["data"], SceneSettings, "data")
        model = build(plain["model"], ModelSettings, "model")
    return Choice(tuple(changed), scene, model, usual_width)


def _place(folder: Path) -> list[str]:
    """Settings for the location of a scene."""
    return [f"data.root={quoted(str(folder.parent))}", f"data.scene={quoted(folder.name)}"]


@functools.cache
def _target(option: str, *search: str) -> str:
    """The settings class that an option of ``data`` names."""
    node = compose_plain(None, [f"+data={option}", *_place(Path("any")), *search])["data"]
    return node["_target_"]


def _recognised(folder: Path, changed: Sequence[str]) -> tuple[Path, str]:
    """The folder of a scene, or its only subfolder with one, and the ``data`` option to read it."""
    search = [text for text in changed if text.startswith(("hydra.searchpath=", "plugins="))]
    modules = compose_plain("train", search).get("plugins") or []
    search = [text for text in search if text.startswith("hydra.")]
    known: dict[type[SceneSettings], str] = {}
    with plugins(modules):
        for option in group_options("data", search):
            target = _target(option, *search)
            known.setdefault(class_of(target, SceneSettings, "data._target_"), option)
    found = [option for cls, option in known.items() if cls.recognises(folder)]
    if len(found) == 1:
        return folder, found[0]
    if found:
        raise ConfigError(
            f"{folder} holds files of several formats ({', '.join(found)}): choose one with "
            f"data={found[0]}"
        )
    deeper = sorted(path for path in folder.iterdir() if path.is_dir())
    deeper = [path for path in deeper if any(cls.recognises(path) for cls in known)]
    if len(deeper) == 1:
        return _recognised(deeper[0], changed)
    inside = [path.name for path in deeper]
    if (folder / "run.json").is_file():
        raise SceneError(
            f"{folder} is a run, not a scene: xplanes render, evaluate and view read it"
        )
    scenes = f" Scenes inside it: {', '.join(inside)}." if inside else ""
    packed = sorted(path.name for path in folder.iterdir() if path.suffix in ARCHIVES)
    unpack = f" Unpack {some(packed)} first." if packed else ""
    splits = {f"transforms_{split}.json" for split in ("train", "val", "test")}
    others = sorted({path.name for path in folder.glob("transforms_*.json")} - splits)
    join = f" Join the frames of {some(others)} in a transforms.json." if others else ""
    there = [f"{path.name}{'/' * path.is_dir()}" for path in folder.iterdir()]
    wanted = "; ".join(f"{name}: {cls.files}" for cls, name in known.items() if cls.files)
    raise SceneError(
        f"{folder} is not a scene of a known format.{scenes} It contains "
        f"{some(sorted(there)) or 'nothing'}.{unpack}{join} What the formats need: {wanted}. "
        "Choose one with data=NAME; raw exports of Polycam, Record3D, Metashape and other "
        "programs become nerfstudio's format with its ns-process-data"
    )


def inspect(choice: Choice) -> Capture:
    """Read a capture and check it.

    Raises:
        SceneError: If it cannot be used.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        choice.scene.prepare()
        scene, model = choice.scene.read(), choice.model
    said = dict.fromkeys(str(each.message) for each in caught if each.category is UserWarning)
    for each in caught:
        if each.category is not UserWarning:  # Of a library: for developers.
            warnings.showwarning(each.message, each.category, each.filename, each.lineno)
    train = scene.splits["train"]
    frame, problem = None, ""
    try:
        frame = model.frame(train, choice.scene.hints(scene))
    except SceneError as error:
        problem = str(error)
    images = {
        split: image_facts(views, scene.background, frame) for split, views in scene.splits.items()
    }
    findings = [Finding("files", text) for text in said]
    findings += [*camera_findings(scene, frame), *image_findings(scene, images)]
    texels = per_texel = None
    if frame is not None:
        width = _width_of_training(choice, scene) or train.width
        share = width / train.width
        pixels = share * pixels_across(train, frame)
        seen = {"pixels": pixels, "positions": train.positions, "surrounded": scene.is_surrounded}
        texels = model.texels(Site(frame, train.times, seed=0, precision="32", **seen))
        if texels is not None:
            per_texel = pixels / texels
            fine = getattr(model, "fine", None) is not None
            findings += texel_findings(per_texel, width, texels, fine=fine)
    follows = {kind for each in findings for kind in CONSEQUENCES.get(each.kind, ())}
    findings = [each for each in findings if each.kind not in follows]
    return Capture(choice, scene, frame, problem, images, tuple(findings), texels, per_texel)


def cameras_of(views: Views) -> list[CameraGroup]:
    """Group views by camera: fixed cameras by pose, moving ones by calibration.

    Cameras count as fixed if each pose has two views or more on average.
    """
    found = _grouped(pose.contiguous().numpy().tobytes() for pose in views.camera_to_world)
    fixed = len(views) > 1 and 2 * len(found) <= len(views)
    if not fixed:
        found = _grouped(calibrations(views))
    folders = [{Path(views.files[i]).parent.name for i in indices} for indices in found]
    told = all(len(names) == 1 for names in folders) and len(set.union(*folders)) == len(found)
    names = [min(names) if told else f"camera {n}" for n, names in enumerate(folders)]
    return [CameraGroup(name, indices, fixed) for name, indices in zip(names, found, strict=True)]


def _grouped(keys: Iterable[Hashable]) -> list[list[int]]:
    """Indices of equal keys, together."""
    groups: dict[Hashable, list[int]] = {}
    for index, key in enumerate(keys):
        groups.setdefault(key, []).append(index)
    return list(groups.values())


def lens_words(views: Views) -> str:
    """The kinds of lenses, with the names of their coefficients that are not 0."""
    lenses = views.intrinsics.lenses
    if lenses is None:
        return "pinhole"
    words = []
    rows = torch.cat([lenses.model[:, None].double(), (lenses.coefficients != 0).double()], dim=1)
    for kind, *has in rows.unique(dim=0).tolist():
        model = LensModel(int(kind))
        named = [name for name, given in zip(COEFFICIENTS, has, strict=True) if given]
        if model == LensModel.FOV:
            named = ["omega"] if named else []
        plain = model == LensModel.PERSPECTIVE and not named
        words.append("pinhole" if plain else " ".join([model.name.lower(), *named]))
    return ", ".join(words)


def distortion(views: Views) -> float:
    """Largest displacement of the images' corners by distortion, in pixels.

    Fisheye lenses are compared with an equidistant one, others with a pinhole. Corners without a
    ray are ignored.
    """
    intrinsics = views.intrinsics
    if intrinsics.lenses is None:
        return 0.0
    lengths = [torch.zeros(1)]
    different = {(*key, *views.size(index)): index for index, key in enumerate(calibrations(views))}
    for index in different.values():
        height, width = views.size(index)
        lens = intrinsics.lenses[index : index + 1]
        rows = torch.tensor([-0.5, -0.5, height - 0.5, height - 0.5], dtype=torch.float64)
        columns = torch.tensor([-0.5, width - 0.5, -0.5, width - 0.5], dtype=torch.float64)
        own = {"focal": intrinsics.focal[index], "centre": intrinsics.centre[index]}
        x, y = image_plane(rows, columns, **own, lenses=lens)
        local, found = lens.directions(x, y)
        straight = replace(Lenses.pinholes(1), model=lens.model, limit=None)
        if lens.model[0] == LensModel.FOV:
            straight = Lenses.pinholes(1)
        ideal_x, ideal_y, seen = straight.image_points(local)
        moved = torch.stack([x - ideal_x, y - ideal_y], dim=1) * intrinsics.focal[index]
        lengths.append(moved.norm(dim=1)[found & seen])
    return float(torch.cat(lengths).max())


def field_of_view(views: Views) -> tuple[float, float]:
    """Horizontal and vertical field of view of the first view, in degrees."""
    height, width = views.size(0)
    rows = torch.tensor([height / 2 - 0.5] * 2 + [-0.5, height - 0.5], dtype=torch.float64)
    columns = torch.tensor([-0.5, width - 0.5] + [width / 2 - 0.5] * 2, dtype=torch.float64)
    _, ends = views.pixel_rays(torch.zeros(4, dtype=torch.long), rows, columns)
    across, down = (
        math.degrees(math.acos(max(-1.0, min(1.0, float(ends[i] @ ends[i + 1]))))) for i in (0, 2)
    )
    return across, down


def facts(capture: Capture) -> dict[str, Any]:
    """The capture as builtins for JSON: lengths in world units, sizes as height and width."""
    scene, frame = capture.scene, capture.frame
    train = scene.splits["train"]
    splits = {name: _split_facts(v, capture.images[name]) for name, v in scene.splits.items()}
    content: dict[str, Any] = {
        "scene": scene.name,
        "format": capture.choice.scene.name,
        "folder": str(capture.choice.scene.folder),
        "overrides": list(capture.choice.overrides),
        "splits": splits,
        "video_frames": None if scene.video is None else len(scene.video),
        "static_reason": scene.static_reason,
        "notes": dict(scene.notes),
        "cube": None,
        "texels": capture.texels,
        "pixels_per_texel": capture.pixels_per_texel,
        "bytes": sum(views.nbytes for views in scene.splits.values()),
        "warnings": [{"kind": each.kind, "text": each.text} for each in capture.findings],
        "error": capture.problem or None,
    }
    if frame is not None:
        away = (train.camera_to_world[:, :3, 3] - frame.centre).norm(dim=-1)
        # Rounded to about a millionth of the cube's size, so that noise becomes 0.
        centre = [round(x * frame.scale, 6) / frame.scale + 0.0 for x in frame.centre.tolist()]
        content["cube"] = {
            "centre": centre,
            "side": 2 / frame.scale,
            "source": frame.source,
            "camera_distance": [float(away.min()), float(away.median()), float(away.max())],
        }
    return content


def _split_facts(views: Views, images: Sequence[ImageFacts]) -> dict[str, Any]:
    groups = cameras_of(views)
    times = time_steps(views)
    spacing = times.diff()
    coverage = sorted(each.coverage for each in images)
    return {
        "views": len(views),
        "looked_at": len(images),
        "sizes": sorted({views.size(index) for index in range(len(views))}),
        "cameras": len(groups),
        "cameras_fixed": groups[0].fixed,
        "lens": lens_words(views),
        "distortion_pixels": distortion(views),
        "field_of_view": list(field_of_view(views)),
        "times": [float(times[0]), float(times[-1])],
        "timesteps": len(times),
        "median_spacing": float(spacing.median()) if len(spacing) else None,
        "largest_gap": float(spacing.max()) if len(spacing) else None,
        "gaps": time_gaps(views),
        "opaque": [coverage[0], coverage[len(coverage) // 2], coverage[-1]],
        "bytes": views.nbytes,
    }


def table(capture: Capture) -> str:
    """The capture as text."""
    known = facts(capture)
    splits = {split: _split_rows(each) for split, each in known["splits"].items()}
    lines = [[name, *(rows[name] for rows in splits.values())] for name in splits["train"]]
    text = [
        f"scene   {known['scene']}, read from {known['folder']} as {known['format']}",
        "",
        markdown(["split", *splits], lines),
        "",
    ]
    for name, words in known["notes"].items():
        stamped = name == "times" and words.startswith('"timestamp"')
        text.append(f"{name:<7} {words}{STAMPED if stamped else ''}")
    if known["video_frames"]:
        video = capture.scene.video
        plain = video is not None and video.is_opaque and capture.scene.is_surrounded
        why = ", without silhouettes: lrm=auto leaves them out" if plain else ""
        text.append(f"video   {known['video_frames']} frames of a fixed camera{why}")
    if known["static_reason"]:
        text.append(f"static  {known['static_reason']}")
    elif known["splits"]["train"]["timesteps"] == 1:
        named = (
            "; data.static=false takes the numbers in the names of images for times"
            if capture.choice.scene.numbers_are_times
            else ""
        )
        text.append(
            "static  all training views have the same time, so nothing can move; if something "
            f'does, the files must give the times (in transforms files, "time" of each frame)'
            f"{named}"
        )
    if (cube := known["cube"]) is not None:
        centre = ", ".join(f"{value:.3g}" for value in cube["centre"])
        near, middle, far = cube["camera_distance"]
        text.append(
            f"cube    {cube['side']:.3g} world units wide around ({centre}), from "
            f"{cube['source']}; cameras are {near:.3g} to {far:.3g} away, median {middle:.3g}"
        )
    if known["pixels_per_texel"] is not None:
        text.append(
            f"texels  {known['texels']} per side of the finest planes: each covers "
            f"{known['pixels_per_texel']:.1f} image pixels at the centre of the cube"
        )
    warned = [f"warning ({each.kind})  {each.text}" for each in capture.findings]
    text += ["", *(warned or ["no warnings"])]
    return "\n".join(text)


def _split_rows(each: Mapping[str, Any]) -> dict[str, str]:
    """The rows of the table for one split."""
    sizes = [f"{width}x{height}" for height, width in each["sizes"]]
    distortion, gap = each["distortion_pixels"], each["largest_gap"]
    first, last = each["times"]
    low, middle, high = each["opaque"]
    opaque = "all" if low >= 0.9995 else f"{low:.0%} to {high:.0%}, median {middle:.0%}"
    if each["looked_at"] < each["views"]:
        opaque += f", {each['looked_at']} views"
    return {
        "views": str(each["views"]),
        "pixels": sizes[0] if len(sizes) == 1 else f"{sizes[0]} to {sizes[-1]}",
        "cameras": f"{each['cameras']} {'fixed' if each['cameras_fixed'] else 'moving'}",
        "lens": each["lens"],
        "distortion": f"{distortion:.1f} px at a corner" if distortion else "none",
        "field of view": "{:.0f} x {:.0f} degrees".format(*each["field_of_view"]),
        "times": f"all {first:g}"
        if first == last
        else f"{each['timesteps']} from {first:.3g} to {last:.3g}",
        "longest gap": "none" if gap is None else f"{gap:.3g}, median {each['median_spacing']:.3g}",
        "opaque pixels": opaque,
        "memory": f"{each['bytes'] / 2**20:.1f} MB",
    }


def next_command(capture: Capture) -> str:
    """The command that trains on the capture, at the format's default width if images are wider."""
    overrides = [*capture.choice.overrides]
    if width := _width_of_training(capture.choice, capture.scene):
        overrides = [f"data.resolution={width}" if text == NATIVE else text for text in overrides]
    return f"{train_command()} {shlex.join(overrides)}"


def _width_of_training(choice: Choice, scene: Scene) -> int | None:
    """The format's default width, if none was set and all images are wider."""
    sizes = torch.cat([views.intrinsics.size for views in scene.splits.values()])
    width = choice.usual_width
    return width if width is not None and width < int(sizes[:, 1].min()) else None


def check_out(out: Path, settings: SceneSettings) -> None:
    """Check the file of the picture.

    Raises:
        ConfigError: If it is no PNG, or is in the folder of the scene.
    """
    if out.suffix.lower() != ".png":
        raise ConfigError(f"--out {out}: must end in .png")
    folder = settings.folder.resolve()
    if out.resolve().is_relative_to(folder):
        raise ConfigError(
            f"--out {out}: is in the scene's own folder {folder}, where nothing is written. Choose "
            "another folder"
        )
