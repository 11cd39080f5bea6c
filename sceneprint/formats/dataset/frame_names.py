"""Which files and folders hold depth, and which other images of the camera, by their names.

Infrared, confidence and label images are 16-bit PNGs as well, and would be read as depth.
"""

from __future__ import annotations

import re

from sceneprint_client.formats import format_named

#: What depth was aligned with, and the name of RGB-D data sets: nothing here says "no depth".
_OF_DEPTH = re.compile(
    r"rgbd|rgb[-_]d(?![a-z])|(colou?r|rgb)_?aligned_?depth|depth_?(colou?r|rgb)_?aligned"
    r"|depth_?(image_?)?(aligned|registered|mapped)?_?(to|2|in|on)_?(colou?r|rgb|infra(red)?|n?ir(?![a-z]))"
)
#: Words of the images that lie beside depth.
_NO_DEPTH = re.compile(
    r"rgb|colou?r|infra|confidence|(?<![a-z])(n?ir|conf|amplitude|labels?|instances?|semantics?|masks?)(?![a-z])"
)
#: Between two words that only their capitals tell apart, such as depthIR.
_CAMEL_CASE = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")

WHAT_IS_LEFT_OUT = "images of colour, infrared, confidence or labels by their names"


def is_beside_depth(name: str) -> bool:
    """Return whether the name of a file or folder says colour, infrared, confidence or labels.

    `aligned_depth_to_color` and `rgbd_depth_0001.png` are depth.
    """
    words = _CAMEL_CASE.sub("_", name).lower()
    return _NO_DEPTH.search(_OF_DEPTH.sub("", words)) is not None


def is_image(file: str) -> bool:
    """Return whether the name of a file is that of an image that depth could be stored in."""
    return format_named(file, "depth") is not None


def is_depth(file: str) -> bool:
    """Return whether the name of a file is that of a depth image."""
    return is_image(file) and not is_beside_depth(file)
