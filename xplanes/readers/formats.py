"""Image files: supported formats, and error messages for others."""

import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from PIL import Image
from PIL.TiffImagePlugin import TiffImageFile

from xplanes.errors import SceneError
from xplanes.files import stand_in

FORMATS = """PNG JPEG MPO WEBP TIFF BMP AVIF JPEG2000 PPM TGA GIF QOI""".split()
"""Pillow's formats that are read; for some others it would run external programs."""

ENDINGS = """.png .jpg .jpeg .jpe .jfif .webp .tif .tiff .bmp .avif .jp2 .ppm .pgm .tga .gif
.qoi""".split()
"""File name endings of these formats."""

RAW = ".dng .nef .cr2 .cr3 .arw .raf .orf .rw2 .pef .srw".split()
"""Endings of cameras' raw files, from which Pillow would read only a thumbnail."""

OTHERS = [*RAW, *".heic .heif .jxl .exr .hdr .psd".split()]
"""Endings of image files that are recognised but not read."""

KINDS = {
    r".{4}ftyp(hei|hev|mif1|msf1)": "HEIC",
    r".{4}ftypavi[fs]": "AVIF",
    r"\xff\n|.{4}JXL ": "JPEG XL",
    r"v/1\x01": "OpenEXR",
    r"#\?RADIANCE": "Radiance HDR",
    r"8BPS": "Photoshop",
    r".{4}ftypcrx|FUJIFILMCCD": "a camera's raw format",
    r".{4}ftyp": "MP4",
    r"\x93NUMPY": "NumPy's format",
    r"%PDF": "PDF",
}
"""First bytes of files in other formats."""

ORIENTATION = 0x0112
"""EXIF tag of an image's orientation."""

SIXTEEN_BIT_MODES = ("I;16", "I;16L", "I;16B", "I")
UNTURN = {
    5: "-transpose",
    6: "-rotate 270",
    7: "-transverse",
    8: "-rotate 90",
}
"""ImageMagick options that undo an EXIF orientation."""

TURNED_BACK = {
    **{2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180},
    **{4: Image.Transpose.FLIP_TOP_BOTTOM, 5: Image.Transpose.TRANSPOSE},
    **{6: Image.Transpose.ROTATE_90, 7: Image.Transpose.TRANSVERSE, 8: Image.Transpose.ROTATE_270},
}
"""Pillow operations that undo an EXIF orientation."""

UNREADABLE = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    struct.error,
    Image.DecompressionBombError,
)


def is_image(path: Path) -> bool:
    """Whether a file is named like an image, in a supported format or not."""
    return path.suffix.lower() in (*ENDINGS, *OTHERS) and not path.name.startswith(".")


def read_header(path: Path) -> tuple[tuple[int, int], bool]:
    """Height and width of an image file, and whether it may have alpha."""
    with open_image(path) as picture:
        alpha = "A" in picture.getbands() or "transparency" in picture.info
        return (picture.height, picture.width), alpha


def orientation(path: Path) -> int:
    """EXIF orientation of an image, from 1 (upright) to 8; pixels are read as they are stored."""
    try:
        with _opened(path) as picture:
            # Checked first, because Pillow would decode a whole PNG to search for the tag.
            if picture.format != "TIFF" and not {"exif", "Raw profile type exif"} & {*picture.info}:
                return 1
            found = picture.getexif().get(ORIENTATION, 1)
    except UNREADABLE:
        return 1
    return found if found in range(1, 9) else 1


def mask_misfit(mask: Path, size: tuple[int, ...], image: Path, wanted: tuple[int, ...]) -> str:
    """Error message for a mask whose size differs from that of its image."""
    text = (
        f"{mask} has {size[1]}x{size[0]} pixels, but {image}, whose mask it is, has "
        f"{wanted[1]}x{wanted[0]}."
    )
    if size == wanted[::-1] and (turn := UNTURN.get(orientation(image))):
        return (
            f"{text} The image's EXIF orientation rotates it for display, and the mask was made "
            "from the rotated image. Images are read as they are stored: rotate the masks back "
            f"(magick mogrify {turn} {mask.parent}/*)."
        )
    if size == wanted[::-1]:
        return (
            f"{text} Its sides are swapped: perhaps it was made from an image that was rotated by "
            "its EXIF orientation. Make it from the image's pixels as they are stored."
        )
    return f"{text} Export the mask at the size of the image."


@cache
def _formats() -> tuple[str, ...]:
    """The entries of `FORMATS` that the installed Pillow supports."""
    Image.init()
    return tuple(name for name in FORMATS if name in Image.OPEN)


def _opened(path: Path) -> Image.Image:
    if path.suffix.lower() in RAW:
        raise OSError("it holds raw sensor data")
    return Image.open(path, formats=_formats())


@contextmanager
def open_image(path: Path) -> Iterator[Image.Image]:
    """Open an image with its pixels as they are stored; usually only the header is read.

    Raises:
        SceneError: If it cannot be decoded, here or in the block.
    """
    try:
        with _opened(path) as picture:
            turn = None
            if isinstance(picture, TiffImageFile):
                # Pillow applies the EXIF orientation only to TIFF files.
                turn = TURNED_BACK.get(picture.tag_v2.get(ORIENTATION, 1))
            stored = picture if turn is None else picture.transpose(turn)
            stored.format = picture.format
            yield stored
    except SceneError:
        raise
    except UNREADABLE as problem:
        raise _unreadable(path, problem) from problem


def _unreadable(path: Path, problem: BaseException) -> SceneError:
    if (other := stand_in(path)) is not None:
        return SceneError(f"{path} {other}.")
    kind = "a camera's raw format" if path.suffix.lower() in RAW else None
    with suppress(OSError), path.open("rb") as file:
        start = file.read(16).decode("latin-1")
        kind = kind or next((KINDS[text] for text in KINDS if re.match(text, start, re.S)), None)
    if kind is not None:
        return SceneError(
            f"{path} is in {kind}, which is not read. Convert all such files to PNG and name "
            f"these where the capture lists them: magick mogrify -format png *{path.suffix}"
        )
    return SceneError(
        f"{path} cannot be decoded as an image ({problem}). It is probably truncated or damaged: "
        "export or download it again."
    )
