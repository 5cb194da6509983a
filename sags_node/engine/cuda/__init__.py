"""The GPU backend: Triton kernels and what calls them.

triton is imported only in the folders `cuda`, and where a GPU is measured. All functions take
contiguous tensors of one device: a CUDA GPU, or the CPU where TRITON_INTERPRET=1 was set before the kernels
were imported. Under Triton's interpreter the kernels run anywhere, slowly, and are tested so.

Whole numbers that change while a video runs specialise no kernel (`do_not_specialize`): one that compiles for
another number of Gaussians would hold a frame up for seconds.
"""

import os

from sags_node.errors import UsageError

try:
    import triton  # noqa: F401  (every module here needs it)
except ModuleNotFoundError as error:
    raise UsageError(
        "the cuda backend needs Triton, which comes with torch's CUDA builds (pip install torch, on Linux); "
        "install one, or choose the numba backend"
    ) from error

# Contract a * b + c to one instruction. Triton means to change its default, which also changes results.
os.environ.setdefault("TRITON_DEFAULT_FP_FUSION", "1")
