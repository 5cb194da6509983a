"""How fast the kernels are on this machine, measured against what it can do at best."""
