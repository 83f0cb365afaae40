"""Captures of a few small images, written as COLMAP and Nerfies would write them."""

import json
import math
import struct
from pathlib import Path

import numpy as np
import torch
import yaml
from PIL import Image

from xplanes.scenes.cameras import look_at

CONF = Path(__file__).parents[1] / "conf" / "data"
WIDTH, HEIGHT = 40, 30


def settings(kind, name, folder, **changes):
    """Settings of a reader with the values of its YAML file, but for the resolution."""
    content = yaml.safe_load((CONF / f"{name}.yaml").read_text())
    content |= {"root": str(folder.parent), "scene": folder.name, "resolution": None, **changes}
    return kind(**{key: value for key, value in content.items() if key != "_target_"})


def poses(count):
    """Cameras around the origin at several heights. float64 [count, 4, 4]"""
    angles = [0.3 + 2 * math.pi * i / count for i in range(count)]
    places = [[4 * math.cos(a), 4 * math.sin(a), 1.0 + 0.5 * math.sin(3 * a)] for a in angles]
    return look_at(torch.tensor(places, dtype=torch.float64)).numpy()


def picture(seed, height=HEIGHT, width=WIDTH):
    """Opaque noise. uint8 [height, width, 3]"""
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def save(path, pixels):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def quaternion(rotation):
    """The unit quaternion of a rotation, real part first, by Bar-Itzhack's eigenvector."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    table = np.array(
        [
            [a - e - i, b + d, c + g, h - f],
            [b + d, e - a - i, f + h, c - g],
            [c + g, f + h, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    x, y, z, w = np.linalg.eigh(table)[1][:, -1]
    return np.array([w, x, y, z])


COLMAP_IDS = {
    **{"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4},
    **{"OPENCV_FISHEYE": 5, "FULL_OPENCV": 6, "FOV": 7, "SIMPLE_RADIAL_FISHEYE": 8},
    **{"RADIAL_FISHEYE": 9, "THIN_PRISM_FISHEYE": 10, "SIMPLE_FISHEYE": 14, "FISHEYE": 15},
}


def write_colmap(folder, cameras, images, points=(), *, text=False):
    """Write a sparse model.

    ``cameras``: {id: (model, width, height, params)}; ``images``: [(name, camera-to-world pose
    with OpenGL's axes, camera id, number of points seen)]; ``points``: positions.
    """
    folder.mkdir(parents=True, exist_ok=True)
    motions = []
    for name, pose, camera, seen in images:
        world_to_camera = (pose[:3, :3] * [1, -1, -1]).T
        shift = -world_to_camera @ pose[:3, 3]
        motions.append((name, [*quaternion(world_to_camera), *shift], camera, seen))
    if text:
        lines = ["# Camera list with one line of data per camera:"]
        for number, (model, width, height, params) in cameras.items():
            lines.append(f"{number} {model} {width} {height} {' '.join(map(repr, params))}")
        (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
        lines = ["# Image list with two lines of data per image:", "#   ..."]
        for number, (name, motion, camera, seen) in enumerate(motions, start=7):
            lines.append(f"{number} {' '.join(repr(float(v)) for v in motion)} {camera} {name}")
            lines.append(" ".join(f"{k}.5 {k + 1}.25 -1" for k in range(seen)))
        (folder / "images.txt").write_text("\n".join(lines) + "\n")
        lines = [
            f"{number} {' '.join(repr(float(v)) for v in point)} 255 0 0 0.5 7 0"
            for number, point in enumerate(points, start=1)
        ]
        (folder / "points3D.txt").write_text("# 3D point list\n" + "\n".join(lines) + "\n")
        return
    data = struct.pack("<Q", len(cameras))
    for number, (model, width, height, params) in cameras.items():
        data += struct.pack("<iiQQ", number, COLMAP_IDS.get(model, model), width, height)
        data += struct.pack(f"<{len(params)}d", *params)
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(motions))
    for number, (name, motion, camera, seen) in enumerate(motions, start=7):
        data += struct.pack("<I7dI", number, *motion, camera) + name.encode() + b"\0"
        data += struct.pack("<Q", seen)
        data += b"".join(struct.pack("<2dq", k + 0.5, k + 1.25, -1) for k in range(seen))
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(points))
    for number, point in enumerate(points, start=1):
        data += struct.pack("<Q3d3BdQ2I", number, *point, 255, 0, 0, 0.5, 1, 7, 0)
    (folder / "points3D.bin").write_bytes(data)


def write_rows(folder, poses, height, width, focal):
    """LLFF's file: a row of each pose, of the size and focal length of its images, near and far."""
    rows = []
    for right, up, back, place in (pose[:3].T for pose in np.asarray(poses)):
        matrix = np.stack([-up, right, back, place, [height, width, focal]], axis=1)
        rows.append([*matrix.ravel(), 1.0, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))


def write_transforms(folder, names, poses, times, **content):
    """nerfstudio's file, with keys that all frames share."""
    frames = [
        {"file_path": name, "transform_matrix": pose.tolist(), "time": time}
        for name, pose, time in zip(names, poses, times, strict=True)
    ]
    (folder / "transforms.json").write_text(json.dumps({**content, "frames": frames}))


class NerfiesFolder:
    """A capture with distorted images whose files can be changed before it is read."""

    def __init__(self, path, count=6):
        self.path, self.ids = path, [f"{i:06d}" for i in range(count)]
        self.lens = {
            "focal_length": 36.0,
            "principal_point": [20.5, 14.25],
            "skew": 1.5,
            "pixel_aspect_ratio": 0.95,
            "radial_distortion": [-0.11, 0.03, 0.002],
            "tangential": [0.004, -0.003],
            "image_size": [WIDTH, HEIGHT],
        }
        self.poses = poses(count)
        for name, pose in zip(self.ids, self.poses, strict=True):
            camera = {
                "orientation": (pose[:3, :3] * [1, -1, -1]).T.tolist(),
                "position": pose[:3, 3].tolist(),
                **self.lens,
            }
            self.write(f"camera/{name}.json", camera)
        self.write(
            "dataset.json",
            {
                "count": count,
                "ids": self.ids,
                "train_ids": self.ids[::2],
                "val_ids": self.ids[1::2],
            },
        )
        self.metadata = {
            name: {"warp_id": 10 + 2 * i, "appearance_id": i, "camera_id": i % 2}
            for i, name in enumerate(self.ids)
        }
        self.write("metadata.json", self.metadata)
        self.write("scene.json", {"scale": 0.25, "center": [0.5, -1, 2], "near": 0.1, "far": 2})
        for i, name in enumerate(self.ids):
            pixels = picture(i)
            save(path / "rgb" / "1x" / f"{name}.png", pixels)
            halves = pixels.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(axis=(1, 3))
            save(path / "rgb" / "2x" / f"{name}.png", halves.round().astype(np.uint8))

    def write(self, name, content):
        path = self.path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content if isinstance(content, str) else json.dumps(content))

    def change(self, name, **changes):
        """Change keys of a JSON file; those set to ... are taken out."""
        content = json.loads((self.path / name).read_text()) | changes
        self.write(name, {key: value for key, value in content.items() if value is not ...})
