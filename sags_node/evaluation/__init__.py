"""How right a run was: metrics, truth, summaries, reports.

Imports config, detail, engine, kernels, mapping, messaging, model, pipeline, sources and vision.
"""
