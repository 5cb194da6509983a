"""How right a run was: metrics, truth, summaries, reports.

Imports config, engine, kernels, mapping, model, node, pipeline, sources, terminal and vision.
"""
