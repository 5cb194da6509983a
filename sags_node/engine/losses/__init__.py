"""What a drawn picture lacks, and its derivative, for the CPU."""
