"""The detail of images from outside: a real node process and real sockets."""

from pathlib import Path

import cv2
import independent_client as client
import numpy as np
import pytest
from running_node import RunningNode
from waiting import START_SECONDS, until

from sags_node.messaging.control import ControlClient

pytestmark = pytest.mark.live

RENDER, DEPTH, VIEW = "left/render/image", "left/render/depth", "view/later/image"
INPUT, MASK = "left/image_rect_color", "left/tissue_mask"
AWAY = np.ones((11, 11), np.uint8)  # px: nearer to an instrument the render is not the image


def test_the_left_render_is_the_picture_where_tissue_is_seen_and_says_how_old_the_rest_is(
    phantom_session: Path, tmp_path: Path
) -> None:
    node = RunningNode(phantom_session, tmp_path, "source.pace:=fast")
    with ControlClient(node.connection["control"]) as control:
        until(lambda: control.request("get_status")["gaussians"], START_SECONDS)
        control.request("open_view", {"name": "later", "ahead_ms": 30, "rate_hz": 30})
        names = [RENDER, INPUT, MASK, DEPTH, VIEW]
        got = client.collect(node.data, names, 20, START_SECONDS)
    assert node.stop() == 0, node.said()
    # A frame that was begun before anybody looked is the model alone, and says nothing of images.
    got[names[0]] = [one for one in got[names[0]] if "detail_age_ns" in one.meta]
    assert len(got[names[0]]) > 10
    by_stamp = [{one.meta["stamp_ns"]: one for one in got[name]} for name in names[:3]]
    stamps = sorted(set.intersection(*map(set, by_stamp)))
    assert stamps, "no frame of which all came"
    for stamp in stamps:
        render, picture, mask = (messages[stamp] for messages in by_stamp)
        height, width = render.meta["shape"][:2]
        shown = client.check_image(render, "rgba8", width, height)
        given = client.check_image(picture, "rgb8", width, height)
        tissue = cv2.erode(client.check_image(mask, "mono8", width, height), AWAY) > 0
        assert tissue.mean() > 0.3
        assert (shown[tissue][:, :3] == given[tissue]).all() and (shown[tissue][:, 3] == 255).all()
        assert 0 <= render.meta["detail_age_ns"] <= 10e9
    views = [one.meta for one in got[names[4]]]
    assert views and all(meta["detail_age_ns"] >= 0 for meta in views)
    assert all("detail_age_ns" not in one.meta for one in got[names[3]])  # depth is the model's
