"""Lenses in transforms files: focal lengths, kinds of lenses and their distortion."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from xplanes.errors import SceneError, warn
from xplanes.readers.entries import checked_number, is_number, is_positive, short
from xplanes.readers.listing import Calibration
from xplanes.scenes.cameras import focal_length
from xplanes.scenes.lenses import COEFFICIENTS, LensModel

PIXELS = ("fl_x", "fl_y", "cx", "cy", "w", "h")
FISHEYES = (
    *("FISHEYE", "OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"),
    "THIN_PRISM_FISHEYE",
)
OTHER_MODELS = (
    *("FISHEYE", "EQUIRECTANGULAR", "ORTHO", "OMNI", "VR180", "DIVISION", "EUCM"),
    *("SPHERICAL", "CYLINDRICAL", "PANORAM", "360"),
)
"""Parts of names of unsupported lens models; `FISHEYES` take precedence."""

PERSPECTIVES = (
    *("PERSPECTIVE", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"),
    *("FULL_OPENCV", "FRAME", "BROWN"),
)
"""Names of perspective lens models."""

OTHER_LENSES = ("equirectangular", "latlong", "orthographic")
"""Flags of unsupported lenses in files of instant-ngp."""

FTHETA = "ftheta_p"
"""Beginning of the keys of instant-ngp's f-theta lens, whose first coefficient is usually 0."""

DISTORTION_PARAMS = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Order of nerfstudio's list of distortion coefficients."""

UNSET = ("k1", "k2", "p1", "p2")
"""Coefficients of lenses that agi2nerf writes as -1 if Metashape's file has none."""

SYNONYMS = {"sx1": "s1", "sy1": "s3"}
"""COLMAP's names of a fisheye lens's prism coefficients."""


def read_calibration(
    where: str, content: Mapping[str, Any], label: str, frame: Mapping[str, Any]
) -> Calibration:
    """The camera of a frame: from its own keys, else from those of the file.

    Args:
        where: The file, for messages.
        content: Content of the file.
        label: The file and frame, for messages.
        frame: Content of the frame.

    Raises:
        SceneError: If a key is missing or out of range, or the lens is not supported.
    """
    shared, own = _pixels(where, content), _pixels(label, frame)
    name, keys = where, content
    if "camera_angle_x" in frame and "fl_x" not in own:
        # The frame's field of view replaces the file's focal lengths.
        shared = {key: value for key, value in shared.items() if key not in ("fl_x", "fl_y")}
        name, keys = label, frame
    elif "fl_x" in own and "fl_x" in shared:
        # As in instant-ngp, a frame's fl_x alone means square pixels.
        shared.pop("fl_y", None)
        shared |= {} if "camera_angle_y" in frame else {"fl_y": own["fl_x"]}
    known = shared | own
    model, distortion = _lens(where, content, label, frame)
    bare = Calibration(model=model, distortion=distortion)
    if "fl_x" in known:
        return replace(bare, **known)
    if model in (LensModel.FISHEYE, LensModel.FOV):
        raise SceneError(
            f'{label}: a {model.name.lower()} lens needs "fl_x", its focal length in pixels. Add '
            "it to the file or to the frame."
        )
    if "camera_angle_x" not in keys:
        raise SceneError(
            f'{where} has no "camera_angle_x" (horizontal field of view in radians). Add it, or '
            f"fl_x and w (focal length and image width in pixels, both above 0)."
        )
    angle = keys["camera_angle_x"]
    if not is_positive(angle) or angle >= math.pi:
        raise SceneError(
            f"{name}: camera_angle_x is {short(angle)}; it must lie between 0 and pi radians."
        )
    return replace(bare, per_width=focal_length(angle, 1), **known)


def _pixels(name: str, keys: Mapping[str, Any]) -> dict[str, float]:
    """The given keys in pixels; null counts as missing, and so does 0 for sizes."""
    if all(keys.get(key) is None for key in PIXELS[:4]):
        # Sizes without a focal length have no effect, so they are not checked.
        return {key: keys[key] for key in ("w", "h") if is_positive(keys.get(key))}
    found = {}
    for key in PIXELS:
        value, above = keys.get(key), key not in ("cx", "cy")
        if value is not None and not (value == 0 and above):
            more = ", in pixels, or be left out"
            found[key] = float(checked_number(name, key, value, above, more))
    return found


def _lens(
    where: str, content: Mapping[str, Any], label: str, frame: Mapping[str, Any]
) -> tuple[LensModel, dict[str, float]]:
    """The kind of lens of a frame, and its distortion."""
    model, name, found = LensModel.PERSPECTIVE, "", {}
    for source, keys in ((where, content), (label, frame)):
        for key, value in keys.items():
            if (key in OTHER_LENSES and value) or (key.startswith(FTHETA) and value is not None):
                raise _not_read(source, f"{key}={short(value)}")
        if keys.get("camera_model"):
            name = str(keys["camera_model"]).upper()
            model = _model(source, name)
        if keys.get("is_fisheye"):
            model = LensModel.FISHEYE
        keys = _listed_distortion(source, keys)
        for key in (*COEFFICIENTS, *SYNONYMS, "omega"):
            value = keys.get(key)
            if value is None:
                continue
            if not is_number(value):
                raise SceneError(
                    f"{source}: {key} is {short(value)}; a distortion coefficient must be a "
                    "number, or be left out."
                )
            found[SYNONYMS.get(key, key)] = float(value)
    unset = [key for key in UNSET if found.get(key) == -1]
    if len(unset) > 1:  # No lens has two coefficients of exactly -1.
        warn(f"{where}: {', '.join(unset)} are -1, as agi2nerf writes it for none: taken for 0.")
        found |= dict.fromkeys(unset, 0.0)
    if model == LensModel.FOV:
        omega = found.get("omega", 0.0)
        if not 0 < omega < math.pi:
            raise SceneError(
                f'{label}: the camera_model FOV needs "omega" between 0 and pi radians, not '
                f"{omega:g}. Correct it, or set camera_model to PINHOLE."
            )
        return model, {"k1": omega}
    rational = name == "FULL_OPENCV" or found.get("k5") or found.get("k6")
    if model == LensModel.PERSPECTIVE and found.get("k4") and not rational:
        model = LensModel.POLYNOMIAL
    return model, {key: found[key] for key in COEFFICIENTS if key in found}


def _listed_distortion(source: str, keys: Mapping[str, Any]) -> Mapping[str, Any]:
    """The keys with nerfstudio's list of coefficients split; single keys take precedence."""
    listed = keys.get("distortion_params")
    if listed is None:
        return keys
    if not isinstance(listed, list) or len(listed) != len(DISTORTION_PARAMS):
        raise SceneError(
            f"{source}: distortion_params is {short(listed)}; it must be a list of the "
            f"{len(DISTORTION_PARAMS)} numbers {', '.join(DISTORTION_PARAMS)}. Give them as keys "
            "of these names."
        )
    return dict(zip(DISTORTION_PARAMS, listed, strict=True)) | dict(keys)


def _model(source: str, name: str) -> LensModel:
    """The kind of lens for a name; unknown names count as perspective cameras, with a warning."""
    if name in FISHEYES:
        return LensModel.FISHEYE
    if any(word in name for word in OTHER_MODELS):
        raise _not_read(source, f"camera_model={name}")
    if name not in (*PERSPECTIVES, "FOV"):
        warn(
            f"camera_model={short(name)} is not known: it is taken for a perspective lens with "
            "OpenCV's coefficients. If it is none, undistort the images."
        )
    return LensModel.FOV if name == "FOV" else LensModel.PERSPECTIVE


def _not_read(source: str, lens: str) -> SceneError:
    return SceneError(
        f"{source}: {lens} is not a lens that is read here. Perspective and fisheye lenses are, "
        "with OpenCV's or COLMAP's coefficients: undistort or convert the images."
    )
