"""Views from the side, compared with the exact truth, which only a synthetic scene has."""

from collections.abc import Callable

from sags_node.config.schema import LaunchConfig, PhantomSource
from sags_node.errors import UsageError
from sags_node.quality import metrics
from sags_node.tools.evaluation.figures import AWAY
from sags_node.tools.evaluation.run import MappedFrame
from sags_node.tools.evaluation.warp import warp_to_right
from sags_node.types import F32, U8, Camera

TIMES = 5  # of the recording that are looked at: a ray-cast view takes a second
SAMPLES = 2  # rays along each side of a pixel

Draw = Callable[[Camera], tuple[F32, F32]]


class Aside:
    """Measures views of the phantom from places that no eye of it has."""

    def __init__(self, config: LaunchConfig, frames: int) -> None:
        """
        Args:
            frames: that are played.

        Raises:
            UsageError: it is not the phantom.
        """
        from sags_node.phantom.scene import Phantom  # only here: it loads Open3D
        from sags_node.phantom.session import frame_count

        if not isinstance(config.source, PhantomSource):
            raise UsageError(
                "--aside needs the built-in phantom: nobody knows what other scenes show from aside"
            )
        self._phantom = Phantom(config.source)
        self._recorded, self._frames = frame_count(config.source), frames
        self._next = frames // TIMES // 2

    def due(self, shown: MappedFrame) -> bool:
        """Tell whether this frame is to be measured: the next of `TIMES` that has a measured depth."""
        number = shown.snapshot.frame_id
        if number < self._next or not shown.measured_depth.any():
            return False
        self._next = number + self._frames // TIMES
        return True

    def __call__(self, shown: MappedFrame, number: int, left: U8, draw: Draw) -> dict[str, dict[str, float]]:
        """Measure `view_2` to `view_20`, named by their distance in mm: dB after a fit of gain and offset,
        where the left eye sees the place too. `psnr` of what is shown, `model_psnr` of the model alone,
        `warp_psnr` of the left image, warped by the frame's own stereo depth.

        Args:
            number: of the frame in the recording.
            left: [H, W, 3] the rectified image.
            draw: what a view shows, and the model alone in it, [H, W, 3] 0..1 each.
        """
        camera = shown.snapshot.camera
        focal_px = float(camera.K[0, 0])
        truth_of = self._phantom.still(number / self._recorded)
        figures = {}
        for millimetres in AWAY:
            baseline = millimetres * 1e-3
            moved = camera.moved_right(baseline)
            truth, depth = truth_of.look(moved, SAMPLES)
            warped, known = warp_to_right(metrics.as_float(left), shown.measured_depth, focal_px, baseline)
            where = known & (depth > 0)
            if where.any():
                pictures = *draw(moved), warped
                names = "psnr", "model_psnr", "warp_psnr"
                figures[f"view_{millimetres}"] = {
                    name: metrics.fitted_psnr(picture, truth, where)
                    for name, picture in zip(names, pictures, strict=True)
                }
        return figures
