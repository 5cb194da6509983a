"""How right a run was: metrics, truth, summaries, reports.

Imports engine, kernels, mapping, model, sources, terminal and vision.
"""
