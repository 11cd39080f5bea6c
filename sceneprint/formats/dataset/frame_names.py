"""Recognition of depth images by the names of files and folders.

Infrared, confidence and label images may be 16-bit PNGs too, but are not depth.
"""

from __future__ import annotations

import re

from sceneprint_client.formats import format_named

#: Parts of names that mention colour or infrared but denote aligned depth or RGB-D data sets.
_OF_DEPTH = re.compile(
    r"rgbd|rgb[-_]d(?![a-z])|(colou?r|rgb)_?aligned_?depth|depth_?(colou?r|rgb)_?aligned"
    r"|depth_?(image_?)?(aligned|registered|mapped)?_?(to|2|in|on)_?(colou?r|rgb|infra(red)?|n?ir(?![a-z]))"
)
#: Words in the names of images that are not depth.
_NO_DEPTH = re.compile(
    r"rgb|colou?r|infra|confidence|disparity|intensity|thermal|(?<![a-z])"
    r"(n?ir|conf|disp|amplitude|normals?|labels?|instances?|segmentation|semantics?|masks?)(?![a-z])"
)
#: Boundary between two words of a camel-case name, such as depthIR.
_CAMEL_CASE = re.compile(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])")

OMITTED_IMAGES = "colour, infrared or other images than depth according to their names"


def is_beside_depth(name: str) -> bool:
    """Return whether the name of a file or folder indicates colour, infrared, confidence or labels.

    `aligned_depth_to_color` and `rgbd_depth_0001.png` indicate depth.
    """
    words = _CAMEL_CASE.sub("_", name).lower()
    return _NO_DEPTH.search(_OF_DEPTH.sub("", words)) is not None


def is_image(file: str) -> bool:
    """Return whether a file has the suffix of an image format that can store depth."""
    return format_named(file, "depth") is not None


def is_depth(file: str) -> bool:
    """Return whether a file is a depth image according to its name."""
    return is_image(file) and not is_beside_depth(file)
