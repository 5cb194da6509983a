"""The interface of all rasterisers: their arguments and results."""

from dataclasses import dataclass
from typing import Protocol

from sags_node.types import F32, I32, Bool, Camera, Gaussians

# The camera model and the limits all backends share; see Mip-Splatting (Yu et al., CVPR 2024).
NEAR_PLANE = 1e-3  # m; nearer Gaussians are not drawn
MIP_VARIANCE = 0.1  # px^2 added to the projected covariance (the 2D Mip filter)
DILATION_VARIANCE = 0.3  # px^2, in its place without antialiasing: 3D Gaussian Splatting (Kerbl et al., 2023)
MIN_ALPHA = 1.0 / 255.0  # a Gaussian is cut off where its alpha falls below this
MAX_OPACITY = 0.999  # keeps 1 - alpha away from zero
MIN_QUAT_NORM = 1e-12  # shorter quaternions have no direction; such Gaussians are not drawn
BEHIND_SURFACE = 0.035  # share of the depth; what is farther than this behind the drawn surface is hidden
FRUSTUM_MARGIN = 0.3  # the Jacobian clamps x/z, y/z to the frustum widened by this share of its half size


@dataclass(frozen=True, slots=True)
class Gradients:
    """Derivatives with respect to the Gaussians' parameters; rows of Gaussians that were not drawn are 0."""

    means: F32  # [N, 3] per m
    quats: F32  # [N, 4] with respect to the quaternion as given, not normalised
    scales: F32  # [N, 3] per m, before the 3D filter
    opacities: F32  # [N] before the filters
    colors: F32  # [N, 3]
    slopes: F32  # [N, 3] before the 3D filter
    sh_rest: F32  # [N, K - 1, 3]; [N, 0, 3] without spherical harmonics
    contribution: F32  # [N] sum over pixels of (blending weight of this Gaussian) * (weight of the pixel)
    spread: F32  # [N] the same, each pixel times its squared distance from the mean in standard deviations


class Rasterizer(Protocol):
    """Draws Gaussians and differentiates the drawing. Not for use by two threads at once."""

    def forward(self, gaussians: Gaussians, camera: Camera, tiles: Bool | None = None) -> F32:
        """Draw for a camera.

        Args:
            gaussians: what is drawn.
            camera: of the rasteriser's image size.
            tiles: [ceil(H / TILE_HEIGHT), ceil(W / TILE_WIDTH)] True: this tile is drawn. The pixels of the
                others keep what the call before left there, and their part of `v_planes` is ignored. None:
                all are drawn.

        Returns:
            Planes [5, H, W]: sums over the Gaussians of w r, w g, w b, w z (m) and w, where
            w = alpha * transmittance; not normalised. A view into the rasteriser's memory, overwritten by
            the next `forward`.

        Raises:
            UsageError: an array or a camera has the wrong shape or size.
            SagsError: the image needs more memory than the engine allows itself.
        """
        ...

    def backward(self, v_planes: F32, weight: F32) -> Gradients:
        """Return gradients of sum(v_planes * planes) for the last `forward`; its arrays must be unchanged.

        Args:
            v_planes: [5, H, W] cotangent of the planes.
            weight: [H, W] pixel weights for `Gradients.contribution`.

        Returns:
            Views into the rasteriser's memory, overwritten by the next `backward`.
        """
        ...

    def median(self) -> tuple[F32, I32]:
        """Return the depth [H, W] (m) at which the transmittance of the last `forward` falls to one half,
        and the row of the Gaussian there [H, W]. Where it stays above: 0 and -1. Tiles that were not drawn
        keep their earlier values."""
        ...
