"""How right a run was: metrics, truth, summaries, reports.

Imports config, detail, engine, kernels, mapping, messaging, model, phantom, pipeline, quality, sources and
vision.
"""
