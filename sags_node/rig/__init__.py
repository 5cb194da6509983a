"""Stereo rigs: calibrations of any usual form read into a checked `StereoRig`.

Imports config.
"""

from sags_node.rig.check import accept_rig, check_eyes, check_intrinsics, check_pair, check_rig, wrong_size
from sags_node.rig.read import (
    GUESSED_FOV,
    Form,
    find_form,
    guessed_rig,
    is_opencv,
    load_camera,
    load_rig,
    read_rig,
    unknown_form,
    with_unit,
)
from sags_node.rig.rig import (
    already_rectified,
    fit_distortion,
    part_of_sensor,
    rectified_camera,
    rectified_rig,
    rectifies,
    rectify_eyes,
    resized_rig,
)
from sags_node.rig.ros import MODELS, eye_files, eye_text, save_rig

__all__ = [
    "GUESSED_FOV", "MODELS", "Form", "accept_rig", "already_rectified", "check_eyes", "check_intrinsics",
    "check_pair", "check_rig", "eye_files", "eye_text", "find_form", "fit_distortion", "guessed_rig",
    "is_opencv", "load_camera", "load_rig", "part_of_sensor", "read_rig", "rectified_camera", "rectified_rig",
    "rectifies", "rectify_eyes", "resized_rig", "save_rig", "unknown_form", "with_unit", "wrong_size",
]  # fmt: skip
