"""Meshes, points, planes, camera paths and a web page: `xplanes export`."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from safetensors.torch import save_file
from torch import Tensor
from tqdm import tqdm

from xplanes.errors import ConfigError, require_between
from xplanes.evaluation.render import FPS
from xplanes.fields.base import SurfaceField, ViewDependentField
from xplanes.fields.xplanes import PLANE_SETS, SPACE_PLANES, TIME_PLANES, XPlanes
from xplanes.files import replacing, require_empty, require_writable, write_json
from xplanes.optional import require
from xplanes.process import say
from xplanes.rendering.base import RayRenderer
from xplanes.rendering.box import ray_box
from xplanes.rendering.grid_renderer import GridRenderer
from xplanes.tools.camera_path import path_contents
from xplanes.tools.export_web import Shape, write_page
from xplanes.tools.runs import TrainedRun

KINDS = ("mesh", "points", "planes", "path", "web")
"""Values of ``--what`` for any field; a field can add others with its `exports`."""

TIMES, WEB_TIMES = 10, 24
"""Default number of timesteps of a dynamic scene, for files and for a web page."""

POINTS = 100_000  # Default number of points of a point cloud.
PAGE = "index.html"  # File name of a web page.
COARSEST = 8  # Least grid points along each side of the cube.
LARGEST = 1024  # Most grid points along each side of the cube; this many take 4 GB.

CAMERAS, RAYS, SAMPLES = 8, 4096, 256
"""Training cameras, rays per camera and samples per ray for the comparison of silhouettes."""

THINNEST, DENSEST, CANDIDATES = 1e-3, 5.0, 96
"""Smallest and largest threshold, as optical depths of a grid cell, and number of candidates."""

PLATEAU = 0.001  # Intersections over union that differ by less count as equal.
EXACT = "_EXACT"  # Name under which trimesh writes linear colours in single precision.

Z_UP_TO_Y_UP = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
"""Rotation from coordinates with z up, which xplanes uses, to y up."""


@dataclass(frozen=True)
class ExportOptions:
    """Options of `xplanes export`.

    Attributes:
        what: ``mesh``, ``points``, ``planes``, ``path``, ``web``, or a name in the field's
            `exports`.
        times: A number of times spread evenly from 0 to 1, or times separated by commas; None for
            10 times, 24 for a web page, or 1 for a static scene.
        resolution: Grid points along each side of the field's cube.
        threshold: Density of the surface, per unit length of the field's frame; None for the
            result of `find_threshold`.
        count: Points of a point cloud; None for 100,000, or for a mesh in a web page.
        form: File format of meshes and point clouds: ``ply`` or ``glb``.
    """

    what: str = "mesh"
    times: str | None = None
    resolution: int = 128
    threshold: float | None = None
    count: int | None = None
    form: str = "ply"

    def check(self) -> None:
        """Check the options without a run.

        Raises:
            ConfigError: If an option is invalid; the message says what is allowed.
            MissingExtraError: For meshes and points without the extra ``export``.
        """
        require_between("--resolution", self.resolution, COARSEST, LARGEST)
        require_between("--points", self.count, 1, 10**8)
        if self.threshold is not None and not 0 < self.threshold < math.inf:
            raise ConfigError(f"--threshold {self.threshold:g}: must be a finite number above 0")
        if self.times is not None:
            export_times(self.times)
        usual, files = ExportOptions(), self.what in ("mesh", "points")
        surface = files or self.what == "web"
        for name, value, default, used in (
            ("times", self.times, usual.times, self.what not in ("planes", "path")),
            ("resolution", self.resolution, usual.resolution, surface),
            ("threshold", self.threshold, usual.threshold, surface),
            ("points", self.count, usual.count, self.what in ("points", "web")),
            ("format", self.form, usual.form, files),
        ):
            if value != default and not used:
                raise ConfigError(
                    f"--{name} {value}: --what {self.what} does not use it; leave it out"
                )
        if files:
            _mesh_tools()


def _mesh_tools() -> tuple[Any, Any]:
    """`skimage.measure` and `trimesh`, of the extra ``export``."""
    return require("skimage.measure", extra="export"), require("trimesh", extra="export")


def export_times(text: str) -> list[float]:
    """Times from "5" (evenly spread from 0 to 1) or "0,0.25,1" (a list).

    Raises:
        ConfigError: If it is neither.
    """
    try:
        if text.isdecimal() and 1 <= int(text) <= 100_000:
            return torch.linspace(0, 1, int(text)).tolist()
        times = [float(part) for part in text.split(",") if part.strip()]
    except ValueError:
        times = []
    # NaN compares as false.
    if text.isdecimal() or not times or not all(0 <= time <= 1 for time in times):
        raise ConfigError(
            f"--times {text}: must be a number of times above 0, such as 5, or times from 0 to 1 "
            'separated by commas, such as 0,0.25,1; one time is written with a point: "0.5"'
        )
    return times


def export(trained: TrainedRun, options: ExportOptions, out: Path | None = None) -> Path:
    """Export a run for other programs, and list the files in ``export.json``.

    Args:
        trained: The run.
        options: Content and format of the export.
        out: Folder to write into, empty or new; ``export/WHAT`` in the run directory when None.

    Returns:
        The folder.

    Raises:
        ConfigError: If options are out of range, do not fit the run, or the field shows nothing.
        MissingExtraError: For meshes and points without the extra ``export``.
    """
    options.check()
    field, name = trained.module.field, trained.experiment.method.model.name
    if options.what not in (*KINDS, *field.exports):
        allowed = " or ".join((*KINDS, *field.exports))
        raise ConfigError(f"--what {options.what}: {name} has none; set --what {allowed}")
    folder = out or trained.path / "export" / options.what
    require_empty(folder)
    require_writable(folder)
    facts: dict[str, Any] = {"what": options.what, "run": str(trained.path)}
    facts |= {"checkpoint": trained.checkpoint, "step": trained.step}
    if options.what in ("planes", "path"):
        write = _write_planes if options.what == "planes" else _write_paths
        facts["files"] = write(folder, trained)
    else:
        if getattr(field, "background", None) is not None:
            facts["left_out"] = "the background outside of the field's cube"
            say(f"left out    {facts['left_out']}; --what planes exports it")
        several = WEB_TIMES if options.what == "web" else TIMES
        times = export_times(options.times or str(several if field.moves else 1))
        facts |= {"times": times} | _write_times(folder, trained, options, times)
    write_json(folder / "export.json", facts)
    return folder


def _write_times(
    folder: Path, trained: TrainedRun, options: ExportOptions, times: list[float]
) -> dict[str, Any]:
    """Write the files that depend on time; return their entries of ``export.json``."""
    paths = [folder / f"{options.what}_{number:04d}" for number in range(len(times))]
    if (write_own := trained.module.field.exports.get(options.what)) is not None:
        pairs = zip(paths, times, strict=True)
        return {"files": [write_own(path, time, trained.frame).name for path, time in pairs]}
    threshold = _threshold(trained, options, times)
    if threshold is not None:
        say(f"threshold   density {threshold:.4g}")
    if options.what == "web":
        return _write_web(folder, trained, options, threshold, times)
    files = [path.with_suffix(f".{options.form}") for path in paths]
    count = None if options.what == "mesh" else options.count or POINTS
    shown = tqdm(times, "times", leave=False, delay=2, disable=None)
    try:
        for time, path in zip(shown, files, strict=True):
            shape = _shape_at(trained, time, options.resolution, threshold, count)
            _write_shape(path, shape)
    except ConfigError:
        for path in files:  # Another threshold can then be tried with the same folder.
            path.unlink(missing_ok=True)
        raise
    facts = {"resolution": options.resolution, "threshold": threshold}
    return {"files": [path.name for path in files], **facts}


def _threshold(trained: TrainedRun, options: ExportOptions, times: list[float]) -> float | None:
    """Density of the surface; None if the field defines a surface or points itself."""
    field, threshold = trained.module.field, options.threshold
    if options.what == "web" and field.cloud(times[0]) is not None:
        own = "points of its own"
    elif not isinstance(trained.module.renderer, RayRenderer):
        others = " or ".join((*field.exports, "path"))
        raise ConfigError(
            f"--what {options.what}: {trained.experiment.method.model.name} has neither a density "
            f"nor a surface; set --what {others}"
        )
    else:
        _mesh_tools()
        if not isinstance(field, SurfaceField):
            return threshold or _find_threshold(trained, options.resolution, times[len(times) // 2])
        own = "a surface of its own"
    if threshold is not None:
        raise ConfigError(
            f"--threshold {threshold:g}: this field has {own} and no density; leave it out"
        )
    return None


def _shape_at(
    trained: TrainedRun, time: float, resolution: int, threshold: float | None, count: int | None
) -> Shape:
    """The coloured surface of one timestep in the world: ``count`` points, or all triangles."""
    mesh = _surface(trained, time, resolution, threshold)
    if count is None:
        places, normals = mesh.vertices, mesh.vertex_normals
    else:
        places, faces = _mesh_tools()[1].sample.sample_surface(mesh, count, seed=0)
        normals = mesh.face_normals[faces]
    points = torch.tensor(places, dtype=torch.float32)
    outward = torch.tensor(normals, dtype=torch.float32)
    # The visible colour of a soft surface comes from slightly below it.
    depth = 0 if threshold is None else 2 / resolution
    colours = _surface_colours(trained, points - depth * outward, outward, time)
    return Shape(trained.frame.to_world(points), colours, mesh.faces if count is None else None)


def _write_shape(path: Path, shape: Shape) -> None:
    """Write a mesh or a point cloud as PLY or GLB."""
    _, trimesh = _mesh_tools()
    linear = path.suffix == ".glb"  # The GLB standard prescribes linear colours, PLY has sRGB.
    colours = _linear(shape.colours) if linear else shape.colours
    pixels, world = (255 * colours).round().byte().numpy(), shape.places.numpy()
    if shape.faces is None:
        found = trimesh.PointCloud(world, colors=pixels)
    else:
        found = trimesh.Trimesh(world, shape.faces, vertex_colors=pixels, process=False)
        if linear:  # Bytes would have hardly any levels in the dark.
            found.vertex_attributes[EXACT] = colours.float().numpy()
    with replacing(path) as temporary:
        temporary.write_bytes(_glb(found) if linear else found.export(file_type="ply"))


def _write_web(
    folder: Path,
    trained: TrainedRun,
    options: ExportOptions,
    threshold: float | None,
    times: list[float],
) -> dict[str, Any]:
    """Write the web page with all timesteps; return its entries of ``export.json``."""
    field = trained.module.field

    def coarser(share: float) -> int:
        # The number of triangles grows with the square of the resolution.
        return max(COARSEST, int(options.resolution * share**0.5))

    def make(time: float, share: float) -> Shape:
        if (cloud := field.cloud(time)) is not None:
            points, colours = cloud
            kept = int(share * min(len(points), options.count or len(points)))
            return Shape(trained.frame.to_world(points[:kept].cpu()), colours[:kept].cpu())
        if options.count is None:
            return _shape_at(trained, time, coarser(share), threshold, None)
        count = max(1, int(share * options.count))
        return _shape_at(trained, time, options.resolution, threshold, count)

    written = write_page(
        folder / PAGE,
        make,
        times,
        title=trained.path.name,
        background=trained.scene.background,
        eye=trained.scene.splits["train"].camera_to_world[0, :3, 3],
    )
    share = written.pop("share")
    facts = {"files": [PAGE], **written, "threshold": threshold}
    if written["triangles"]:
        facts["resolution"] = coarser(share)
        shown = f"{written['triangles']:,} triangles at resolution {coarser(share)}"
    else:
        shown = f"{written['vertices']:,} points"
    fitted = "" if share == 1 else f"; reduced to {share:.0%} to stay below 20 MB"
    say(f"page        {len(times)} timesteps, {shown}{fitted}; {written['bytes'] / 1e6:.1f} MB")
    return facts


def _glb(geometry: Any) -> bytes:
    """A GLB file with y up and a matt material.

    In GLB files the y axis points up, in the world the z axis. The default material is metallic,
    and black where nothing is reflected.
    """
    _, trimesh = _mesh_tools()
    scene = trimesh.Scene()
    scene.add_geometry(geometry, transform=Z_UP_TO_Y_UP)

    def matt(tree: dict[str, Any]) -> None:
        plain = {"baseColorFactor": [1.0] * 4, "metallicFactor": 0.0, "roughnessFactor": 1.0}
        tree["materials"] = [{"pbrMetallicRoughness": plain}]
        for mesh in tree["meshes"]:
            for primitive in mesh["primitives"]:
                primitive["material"] = 0
                attributes = primitive["attributes"]
                if EXACT in attributes:
                    attributes["COLOR_0"] = attributes.pop(EXACT)

    return scene.export(file_type="glb", tree_postprocessor=matt)


def _linear(colours: Tensor) -> Tensor:
    """Convert colours from sRGB to linear. [...]"""
    return torch.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)


@torch.no_grad()
def _surface(trained: TrainedRun, time: float, resolution: int, threshold: float | None) -> Any:
    """The closed ``trimesh.Trimesh`` of one timestep in the field's frame, by marching cubes.

    Args:
        trained: The run.
        time: From 0 to 1.
        resolution: Grid points along each side of the field's cube.
        threshold: Density of the surface; None for a field of signed distances, whose surface is
            their zero level set.

    Raises:
        ConfigError: If there is no surface.
    """
    measure, trimesh = _mesh_tools()
    volume, empty = _solidity(trained, time, resolution)
    level = 0.0 if threshold is None else -math.expm1(-threshold * 2 / resolution)
    largest = float(volume.max())
    if not largest > level:
        if threshold is None:
            raise ConfigError(
                f"at time {time:g} the field has no surface in its cube: train longer"
            )
        most = -math.log1p(-largest) * resolution / 2 if largest < 1 else math.inf
        raise ConfigError(
            f"at time {time:g} the field's density is nowhere above the threshold "
            f"{threshold:.4g}; the largest is {most:.4g}: set --threshold to less"
        )
    # Padding with empty values closes the surface where it meets the cube.
    padded = F.pad(volume, [1] * 6, value=empty).numpy()
    # Faces are counter-clockwise when seen from the side with smaller values.
    vertices, faces, _, _ = measure.marching_cubes(
        padded, level, gradient_direction="ascent", allow_degenerate=False
    )
    return trimesh.Trimesh((vertices - 0.5) * (2 / resolution) - 1, faces, process=False)


@torch.no_grad()
def _solidity(trained: TrainedRun, time: float, resolution: int) -> tuple[Tensor, float]:
    """Sample the field at the centres of a grid's cells, as opacity or as depth below its surface.

    Opacity of one cell is used instead of density: density varies widely inside solid objects, so
    it interpolates badly. A field of signed distances gives the depth below the surface, clamped
    to a cell on either side. Points in empty cells of the occupancy grid are not evaluated.

    Returns:
        Values on the CPU, axes x, y, z [resolution] * 3; and the value of empty space.
    """
    field, renderer = trained.module.field, trained.module.renderer
    device, cell = renderer.device, 2 / resolution
    empty = -cell if isinstance(field, SurfaceField) else 0.0
    volume = torch.full((resolution**3,), empty)
    chunk = 2**15 if device.type == "cpu" else 2**19
    for index in torch.arange(resolution**3).split(chunk):
        place = torch.stack([index // resolution**2, index // resolution, index], dim=1)
        points = ((place % resolution + 0.5) * cell - 1).to(device)
        seen = _looked_at(trained, points, time).nonzero()[:, 0]
        if not len(seen):
            continue
        points = points[seen]
        times = torch.full_like(points[:, 0], time)
        if isinstance(field, SurfaceField):
            value = -field.signed_distance(points, times).clamp(-cell, cell)
        else:
            whole = not isinstance(field, ViewDependentField)
            density = field(points, times)[1] if whole else field.geometry(points, times)[0]
            value = -torch.expm1(-cell * density.float())
        volume[index[seen.cpu()]] = value.nan_to_num(empty).cpu().float()
    return volume.view(resolution, resolution, resolution), empty


def _looked_at(trained: TrainedRun, points: Tensor, time: float) -> Tensor:
    """Whether the renderer evaluates the field at points of the cube. bool [N]"""
    renderer = trained.module.renderer
    if isinstance(renderer, GridRenderer) and renderer.skip_empty:
        grid = renderer.grid
        return grid.occupied[grid.cells(points, torch.full_like(points[:, 0], time))]
    assert isinstance(renderer, RayRenderer)
    return renderer.reaches(points)


@torch.no_grad()
def _find_threshold(trained: TrainedRun, resolution: int, time: float) -> float:
    """The density threshold whose surface matches the field's silhouettes best.

    Silhouettes are those of training cameras. A pixel is in the field's silhouette if its opacity
    is at least 0.5, and in the surface's if its ray passes a density above the threshold. The
    threshold maximises the intersection over union of the two.

    Raises:
        ConfigError: If no pixel has an opacity of 0.5.
    """
    volume = _solidity(trained, time, resolution)[0]
    views, renderer = trained.scene.splits["train"], trained.module.renderer
    assert isinstance(renderer, RayRenderer)
    shown, peaks = [], []
    for index in range(0, len(views), -(-len(views) // CAMERAS)):
        origins, directions = trained.frame.rays(*views.image_rays(index))
        stride = -(-len(origins) // RAYS)
        origins, directions = origins[::stride], directions[::stride]
        image = renderer.image(
            trained.module.field,
            origins.to(renderer.device),
            directions.to(renderer.device),
            time,
            trained.scene.background.to(renderer.device),
        )
        shown.append(image["opacity"].cpu() >= 0.5)
        peaks.append(_peaks(volume, origins, directions))
    inside, peak = torch.cat(shown), torch.cat(peaks)
    if not inside.any():
        raise ConfigError(
            f"at time {time:g} no pixel of the training cameras has an opacity of 0.5, so the "
            "field has no silhouette: train longer, or set --threshold"
        )
    depths = torch.logspace(math.log10(THINNEST), math.log10(DENSEST), CANDIDATES)
    hit = peak[:, None] > -torch.expm1(-depths)
    both = (hit & inside[:, None]).sum(dim=0)
    agreement = both / (hit | inside[:, None]).sum(dim=0)
    best = (agreement >= agreement.max() - PLATEAU).nonzero()[:, 0]
    return float(depths[best[len(best) // 2]]) * resolution / 2


def _peaks(volume: Tensor, origins: Tensor, directions: Tensor) -> Tensor:
    """Largest interpolated value along each ray in a grid over the cube. [R]"""
    near, far = ray_box(origins, directions)
    share = (torch.arange(SAMPLES) + 0.5) / SAMPLES
    distances = near[:, None] + (far - near)[:, None] * share
    points = origins[:, None] + distances[..., None] * directions[:, None]
    grid = volume.permute(2, 1, 0)[None, None].contiguous()
    found = F.grid_sample(grid, points[None, None], align_corners=False)
    return found[0, 0, 0].amax(dim=1) * (far > near)


@torch.no_grad()
def _surface_colours(trained: TrainedRun, points: Tensor, normals: Tensor, time: float) -> Tensor:
    """Colours on the CPU of points of the field's frame, against outward normals. [N, 3] each"""
    field, device = trained.module.field, trained.module.renderer.device
    colours = []
    for part, normal in zip(points.split(2**15), normals.split(2**15), strict=True):
        place, facing = part.to(device), -normal.to(device)
        times = torch.full_like(place[:, 0], time)
        if isinstance(field, SurfaceField):
            colour = field.surface_colour(place, times, facing)
        elif field.view_dependent:
            colour = field(place, times, facing)[0]
        else:
            colour = field(place, times)[0]
        colours.append(colour.float().clamp(0, 1).cpu())
    return torch.cat(colours)


def _write_paths(folder: Path, trained: TrainedRun) -> list[str]:
    """Write the training cameras in the order of their times; return the files' names."""
    contents = path_contents(trained.scene.splits["train"], FPS)
    for name, content in contents.items():
        write_json(folder / name, content)
    return list(contents)


def _write_planes(folder: Path, trained: TrainedRun) -> list[str]:
    """Write an X-Planes field as docs/recipes.md describes it; return the file's name."""
    field, renderer, frame = trained.module.field, trained.module.renderer, trained.frame
    if type(field) is not XPlanes:  # A derived field may have more than planes and a decoder.
        raise ConfigError(
            f"--what planes: {trained.experiment.method.model.name} has no planes in the layout of "
            "X-Planes; mesh and points work with every radiance field"
        )
    tensors = {f"planes.{name}": plane for name, plane in field.planes.items()}
    tensors |= field.decoder.state_dict(prefix="decoder.")
    if isinstance(renderer, GridRenderer):
        grid = renderer.grid
        tensors["occupied"] = grid.occupied.view(grid.time_bins, *[grid.resolution] * 3)
    behind: dict[str, Any] | None = None
    if (background := field.background) is not None:
        behind = {"decoder": background.decoder.options, "samples": background.samples}
        for name, plane in zip(SPACE_PLANES, background.planes, strict=True):
            tensors[f"background.planes.{name}"] = plane.permute(2, 0, 1)
        tensors |= background.decoder.state_dict(prefix="background.decoder.")
    names = TIME_PLANES[field.plane_set]
    pairs = [[names[plane] for plane in pair] for pair in PLANE_SETS[field.plane_set]]
    content = {
        "format": 1,
        "products": dict(zip(SPACE_PLANES, pairs or [[]] * 3, strict=True)),
        "decoder": field.decoder.options,
        "background": behind,
        "frame": {
            "scale": frame.scale,
            "rotation": frame.rotation.tolist(),
            "centre": frame.centre.tolist(),
        },
    }
    whole = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    name = "planes.safetensors"
    with replacing(folder / name) as temporary:
        save_file(whole, temporary, metadata={"xplanes": json.dumps(content)})
    return [name]
