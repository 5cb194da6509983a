"""How fast the kernels are, beside what the machine can do at best."""
