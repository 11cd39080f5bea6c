"""Values of a frame's row, with defaults."""


def frame_values(content_id, **fields):
    """Return the values of a small depth image without a pose, except for those given."""
    return {
        "content_id": content_id, "blob": "00" * 32, "bytes": 3, "intrinsics": {"width": 1},
        "depth_scale": 1000.0, "depth_along_ray": False, "robot": None, "session": None,
        "captured_at": None, "tags": [], "pose_parent": None, "pose": None, "name": None,
        "sequence": None,
    } | fields  # fmt: skip
