"""What goes wrong between the camera and the node: cables, capture cards, codecs, and another scene."""

from dataclasses import replace

import cv2
import numpy as np

from benchmarks.disturbances.moment import Moment, right_of
from sags_node.types import U8, StereoFrame

LATE = 3  # frames
LOST = 0.2  # share of the frames
JPEG_QUALITY = 6
KNOCKED_DEGREES = 0.5
KNOCKED_ROWS = 4 / 640  # vertical shift, share of the width


def clean(moment: Moment) -> StereoFrame:
    """Nothing is wrong."""
    return moment.frame


def black_right(moment: Moment) -> StereoFrame:
    """The right eye's cable is out."""
    return replace(moment.frame, right=np.zeros_like(moment.right))


def frozen_right(moment: Moment) -> StereoFrame:
    """The right eye shows the last image from before it began, again and again."""
    return replace(moment.frame, right=moment.earlier(moment.index + 1).right)


def frozen(moment: Moment) -> StereoFrame:
    """A live feed shows the last images from before it began, again and again, in both eyes."""
    last = moment.earlier(moment.index + 1)
    arrival_ns = moment.frame.t_capture_ns  # as a camera's images have one, and a recording's have not
    return replace(moment.frame, left=last.left, right=last.right, t_arrival_ns=arrival_ns)


def late_right(moment: Moment) -> StereoFrame:
    """The right eye is `LATE` frames behind, and its stamps do not say so."""
    return replace(moment.frame, right=moment.earlier(LATE).right)


def swapped(moment: Moment) -> StereoFrame:
    """Each eye is in the other's place."""
    return replace(moment.frame, left=moment.right, right=moment.frame.left)


def equal(moment: Moment) -> StereoFrame:
    """The left eye is fed to both inputs."""
    return replace(moment.frame, right=moment.frame.left.copy())


def cut(moment: Moment) -> StereoFrame:
    """Another scene: this one upside down, as the same rig would see it."""
    frame, (left, right) = moment.frame, moment.scene.mirrors

    def mirrored(picture: U8, pixels: np.ndarray) -> U8:
        return np.asarray(
            cv2.remap(picture, pixels, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        )

    tissue = frame.tissue
    if tissue is not None:
        tissue = mirrored(np.where(tissue, np.uint8(255), np.uint8(0)), left) > 127
    return replace(
        frame, left=mirrored(frame.left, left), right=mirrored(right_of(frame), right), tissue=tissue
    )


def lost_frames(moment: Moment) -> StereoFrame | None:
    """A share of the frames, by chance, never comes."""
    return None if moment.random(0).random() < LOST else moment.frame


def jpeg(moment: Moment) -> StereoFrame:
    """A capture card that compresses far too much."""

    def compressed(picture: U8, eye: int) -> U8:
        data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
        decoded = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)
        return np.ascontiguousarray(decoded[..., ::-1])

    return moment.both(compressed)


def knocked(moment: Moment) -> StereoFrame:
    """The right camera was hit: it is turned about its axis, and looks higher."""
    height, width = moment.right.shape[:2]
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), KNOCKED_DEGREES, 1.0)
    turn[1, 2] += KNOCKED_ROWS * width
    right = cv2.warpAffine(moment.right, turn, (width, height), borderMode=cv2.BORDER_REPLICATE)
    return replace(moment.frame, right=np.asarray(right))
