"""The mapper's steps on a GPU: `refiner.GpuRefiner` in the place of `mapping.refiner.CpuRefiner`."""
