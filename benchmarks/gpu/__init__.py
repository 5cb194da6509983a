"""What a GPU is worth: kernels beside the CPU's and gsplat's, the mapper, live runs and the fit."""
